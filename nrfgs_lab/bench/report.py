# SPDX-License-Identifier: Apache-2.0
"""Report of a benchmark: tables, crops, and a trade's figure."""

import json
from pathlib import Path
from typing import Any

from nrfgs_lab.bench import trade
from nrfgs_lab.bench.crops import crop_sheet, numbered
from nrfgs_lab.bench.job import read_record
from nrfgs_lab.bench.spec import OWN, Cell, Spec
from nrfgs_lab.bench.table import COLUMNS, FAILED, MISSING, STALE, Row, markdown, with_averages
from nrfgs_ns.files import write_whole

FAILURE = ".failed"
"""Ending of the note that a run's last attempt failed, beside its record."""


def report(spec: Spec, cells: list[Cell], out: Path, work: Path, stale: dict[str, str]) -> None:
    """Print the table; write table.md, summary.json, crops/ (of pictures in `work`), with knobs tradeoff.{md,png} into
    OUT, whose runs/ holds the records. `stale` ones, name -> difference, are left out."""
    rows = rows_from_records(cells, out / "runs", stale)
    for name, difference in stale.items():
        print(f"{name} is stale: it was made with {difference}")
    everything = with_averages(rows)
    table = markdown(everything)
    write_whole(out / "table.md", table)
    write_whole(out / "summary.json", json.dumps([summary(row) for row in everything], indent=1) + "\n")
    for scene in dict.fromkeys(cell.scene.name for cell in cells):
        here = [cell for cell in cells if cell.scene.name == scene and cell.name not in stale]
        path = out / "crops" / f"{scene.replace('/', '_')}.png"
        try:
            crop_sheet(pictures_of(here, out / "runs", work), path)
        except (OSError, ValueError) as error:
            print(f"No crops of {scene}: {error}")
    knobs = {run.name: run.knob for run in spec.runs if run.knob}
    if knobs:
        trade.report(everything, knobs, out)
    print(table)
    print(f"Report: {out}")


def pictures_of(cells: list[Cell], runs: Path, work: Path) -> dict[str, Path]:
    """Folder of ns-eval's pictures by run, of its first seed with pictures; labels name seeds if they differ."""
    first: dict[str, tuple[int, Path]] = {}
    for cell in cells:
        folder = work / cell.name / "pictures"
        if (runs / f"{cell.name}.json").exists() and numbered(folder):
            label = cell.run.name if cell.strategy == OWN else f"{cell.run.name} {cell.strategy}"
            first.setdefault(label, (cell.seed, folder))
    several = len({seed for seed, _ in first.values()}) > 1
    return {f"{text}, seed {seed}" if several else text: folder for text, (seed, folder) in first.items()}


def rows_from_records(cells: list[Cell], runs: Path, stale: dict[str, str]) -> list[Row]:
    """A row for each scene, strategy and run."""
    by_place: dict[tuple[str, str, str], Row] = {}
    for cell in cells:
        place = (cell.scene.name, cell.run.name, cell.strategy)
        row = by_place.setdefault(place, Row(*place))
        file = runs / f"{cell.name}.json"
        if cell.name in stale:
            row.absent[cell.seed] = STALE
        elif file.exists():
            row.records[cell.seed] = read_record(file)
        else:
            row.absent[cell.seed] = FAILED if file.with_suffix(FAILURE).exists() else MISSING
    return [row.fill() for row in by_place.values()]


def summary(row: Row) -> dict[str, Any]:
    """A row as plain data."""
    place = {"scene": row.scene, "run": row.run, "strategy": row.strategy, "seeds": sorted(row.records)}
    absent = {str(seed): why for seed, why in row.absent.items()}
    values = {column.name: [row.mean(column), row.deviation(column)] for column in COLUMNS}
    return {**place, "absent": absent, **values}
