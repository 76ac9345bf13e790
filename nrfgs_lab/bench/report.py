# SPDX-License-Identifier: Apache-2.0
"""Report of a benchmark: tables, numbers of splats over steps, crops, and a trade's figure."""

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from nrfgs_lab.bench import trade
from nrfgs_lab.bench.crops import crop_sheet, numbered
from nrfgs_lab.bench.spec import OWN, Cell, Spec, read_record
from nrfgs_lab.bench.table import COLUMNS, FAILED, MISSING, STALE, Row, markdown, plain_label, with_averages
from nrfgs_ns.files import whole, write_whole

FAILURE = ".failed"
"""Ending of the note that a run's last attempt failed, beside its record."""


def report(spec: Spec, cells: list[Cell], out: Path, work: Path, stale: dict[str, str]) -> None:
    """Print the table; write table.md, summary.json, splats.png, crops/, with knobs tradeoff.{md,png} into OUT.

    Args:
        spec: the benchmark.
        cells: the trainings to report.
        out: folder of the report; its runs/ holds the records.
        work: folder of the trainings, for their pictures; without them there are no crops.
        stale: records to leave out: name -> difference.
    """
    rows = rows_from_records(cells, out / "runs", stale)
    for name, difference in stale.items():
        print(f"{name} is stale: it was made with {difference}")
    everything = with_averages(rows)
    table = markdown(everything)
    write_whole(out / "table.md", table)
    write_whole(out / "summary.json", json.dumps([summary(row) for row in everything], indent=1) + "\n")
    if any(row.records for row in rows):
        draw_splats(rows, out)
    for scene in dict.fromkeys(cell.scene.name for cell in cells):
        here = [cell for cell in cells if cell.scene.name == scene and cell.name not in stale]
        path = out / "crops" / f"{scene.replace('/', '_')}.png"
        try:
            crop_sheet(pictures_of(here, out / "runs", work), path)
        except OSError as error:
            print(f"No crops of {scene}: {error}")
    knobs = {run.name: run.knob for run in spec.runs if run.knob}
    if knobs:
        trade.report(everything, knobs, out)
    Console(soft_wrap=True, markup=False, highlight=False).print(table)
    print(f"Report: {out}")


def pictures_of(cells: list[Cell], runs: Path, work: Path) -> dict[str, Path]:
    """Folder of ns-eval's pictures by run, of its first seed with pictures; labels name seeds if they differ."""
    first: dict[str, tuple[int, Path]] = {}
    for cell in cells:
        folder = work / cell.name / "pictures"
        if (runs / f"{cell.name}.json").exists() and numbered(folder):
            first.setdefault(label(cell.run.name, cell.strategy), (cell.seed, folder))
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
    values = {column.name: [row.mean(column), row.deviation(column)] for column in COLUMNS}
    return {
        "scene": row.scene,
        "run": row.run,
        "strategy": row.strategy,
        "seeds": sorted(row.records),
        "absent": {str(seed): why for seed, why in row.absent.items()},
        **values,
    }


def label(run: str, strategy: str) -> str:
    """Name of a run under a strategy in pictures."""
    return run if strategy == OWN else f"{run} {strategy}"


def draw_splats(rows: list[Row], out: Path) -> None:
    """Write OUT/splats.png: mean and range over seeds by step, a panel for each scene and strategy."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = list(dict.fromkeys(row.scene for row in rows if row.records))
    strategies = list(dict.fromkeys(row.strategy for row in rows if row.records))
    runs = list(dict.fromkeys(row.run for row in rows if row.records))
    places = [(scene, strategy) for scene in scenes for strategy in strategies]
    across = min(3, len(scenes)) if len(strategies) == 1 else len(strategies)
    down = -(-len(places) // across)
    with pyplot.rc_context({"font.size": 8}):
        size = 3.6 * across, 2.6 * down + 0.3
        figure, panels = pyplot.subplots(down, across, figsize=size, squeeze=False, layout="constrained")
        for panel in panels.flat[len(places) :]:
            panel.set_visible(False)
        for panel, (scene, strategy) in zip(panels.flat, places, strict=False):
            for row in rows:
                if (row.scene, row.strategy) == (scene, strategy) and row.records:
                    draw_counts(panel, row, runs.index(row.run))
            panel.set(title=plain_label(label(scene, strategy)), xlabel="step", ylabel="splats", ylim=(0, None))
            panel.yaxis.set_major_formatter("{x:,.0f}")
        lines = {line.get_label(): line for panel in panels.flat for line in panel.get_lines()}
        ordered = [plain_label(run) for run in runs if plain_label(run) in lines]
        figure.legend([lines[name] for name in ordered], ordered, loc="outside lower center", ncols=min(5, 2 * across))
        with whole(out / "splats.png") as aside:
            figure.savefig(aside, format="png", dpi=150, metadata={"Software": None})
        pyplot.close(figure)


STYLES = "-", "--", ":", "-."
"""Line styles, each for ten colours."""


def draw_counts(panel, row: Row, number: int) -> None:
    """Draw one row's numbers of splats, in the colour and style of its run's number."""
    counts = [record["train"].get("splats") for record in row.records.values()]
    curves = [dict(map(tuple, pairs)) for pairs in counts if pairs]
    if not curves:
        return
    steps = sorted(set.intersection(*(set(curve) for curve in curves)))
    counts = [[curve[step] for curve in curves] for step in steps]
    colour, style = f"C{number % 10}", STYLES[number // 10 % len(STYLES)]
    means = [sum(of_step) / len(curves) for of_step in counts]
    panel.plot(steps, means, label=plain_label(row.run), color=colour, linestyle=style, linewidth=1.2)
    least, most = list(map(min, counts)), list(map(max, counts))
    if least != most:
        panel.fill_between(steps, least, most, color=colour, alpha=0.2, linewidth=0)
