# SPDX-License-Identifier: Apache-2.0
"""The report of a benchmark, from the records that are there: tables, numbers of splats over steps, crops."""

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from nrfgs_ns.studies.bench_crops import crop_sheet
from nrfgs_ns.studies.bench_spec import Cell, Spec, cells_of, read_record, rows_of
from nrfgs_ns.studies.bench_table import COLUMNS, Row, as_csv, latex, markdown, with_averages
from nrfgs_ns.studies.files import whole, write_whole


def report(spec: Spec, out: Path, work: Path, stale: dict[str, str]) -> None:
    """Write OUT/table.{md,csv,tex}, summary.json, splats.{png,svg} and crops/SCENE.png, and print the table.

    Args:
        spec: the benchmark.
        out: folder of the report; its runs/ holds the records.
        work: folder of the trainings, for their pictures; without them there are no crops.
        stale: names of records that are not to be used, with the reason.
    """
    rows = rows_from_records(spec, out / "runs", stale)
    for name, difference in stale.items():
        print(f"{name} is stale: it was made with {difference}")
    everything = with_averages(rows)
    table = markdown(everything)
    write_whole(out / "table.md", table)
    write_whole(out / "table.csv", as_csv(everything))
    write_whole(out / "table.tex", latex(everything))
    write_whole(out / "summary.json", json.dumps([summary(row) for row in everything], indent=1) + "\n")
    if any(row.records for row in rows):
        draw_splats(rows, out)
    for scene in spec.scenes:
        pictures = {}
        for protocol, run in rows_of(spec):
            cell = Cell(run, protocol, scene, spec.seeds[0])
            if cell.name not in stale and (out / "runs" / f"{cell.name}.json").exists():
                pictures[label(run.name, protocol)] = work / cell.name / "pictures"
        views = spec.crops.get(scene.name)
        path = out / "crops" / f"{scene.name.replace('/', '_')}.png"
        crop_sheet(pictures, path, views)
    Console(soft_wrap=True, markup=False, highlight=False).print(table)
    print(f"Report: {out}")


def rows_from_records(spec: Spec, runs: Path, stale: dict[str, str]) -> list[Row]:
    """One row for each scene, protocol and run, whether or not it has records."""
    by_place: dict[tuple[str, str, str], Row] = {}
    for cell in cells_of(spec):
        place = (cell.scene.name, cell.run.name, cell.protocol)
        row = by_place.setdefault(place, Row(*place))
        file = runs / f"{cell.name}.json"
        if cell.name in stale:
            row.absent[cell.seed] = "stale"
        elif file.exists():
            row.records[cell.seed] = read_record(file)
        else:
            row.absent[cell.seed] = "FAILED" if file.with_suffix(".failed").exists() else "missing"
    return [row.fill() for row in by_place.values()]


def summary(row: Row) -> dict[str, Any]:
    """A row as plain data."""
    values = {column.name: [row.mean(column), row.deviation(column)] for column in COLUMNS}
    return {
        "scene": row.scene,
        "run": row.run,
        "protocol": row.protocol,
        "seeds": sorted(row.records),
        "absent": {str(seed): why for seed, why in row.absent.items()},
        **values,
    }


def label(run: str, protocol: str) -> str:
    """What a run under a protocol is called in pictures."""
    return run if protocol == "own" else f"{run} {protocol}"


def plain_label(text: str) -> str:
    """A name as matplotlib writes it out: `$` begins no formula, and a leading underscore keeps it in the legend."""
    return ("\N{ZERO WIDTH SPACE}" if text.startswith("_") else "") + text.replace("$", r"\$")


def draw_splats(rows: list[Row], out: Path) -> None:
    """Number of splats over training steps, mean over seeds: OUT/splats.png and .svg, one panel for each scene."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = list(dict.fromkeys(row.scene for row in rows))
    kinds = list(dict.fromkeys(label(row.run, row.protocol) for row in rows))
    across = min(3, len(scenes))
    down = -(-len(scenes) // across)
    # Text as text keeps the SVG small; a fixed salt gives the same file for the same numbers.
    with pyplot.rc_context({"svg.fonttype": "none", "svg.hashsalt": "nrfgs", "font.size": 8}):
        figure, panels = pyplot.subplots(down, across, figsize=(3.6 * across, 2.6 * down), squeeze=False)
        for panel in panels.flat[len(scenes) :]:
            panel.set_visible(False)
        for panel, scene in zip(panels.flat, scenes, strict=False):
            for row in (row for row in rows if row.scene == scene and row.records):
                curves = [dict(map(tuple, record["train"]["splats"])) for record in row.records.values()]
                steps = sorted(set.intersection(*(set(curve) for curve in curves)))
                counts = [sum(curve[step] for curve in curves) / len(curves) for step in steps]
                name = label(row.run, row.protocol)
                panel.plot(steps, counts, label=plain_label(name), color=f"C{kinds.index(name)}", linewidth=1.2)
            panel.set(title=plain_label(scene), xlabel="step", ylabel="splats", ylim=(0, None))
        lines = {line.get_label(): line for panel in panels.flat for line in panel.get_lines()}
        panels.flat[0].legend(lines.values(), lines.keys(), fontsize=7)
        figure.tight_layout()
        with whole(out / "splats.png") as aside:
            figure.savefig(aside, format="png", dpi=150, metadata={"Software": None})
        with whole(out / "splats.svg") as aside:
            figure.savefig(aside, format="svg", metadata={"Date": None})
        pyplot.close(figure)
