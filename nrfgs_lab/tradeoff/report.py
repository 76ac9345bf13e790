# SPDX-License-Identifier: Apache-2.0
"""The report of a trade: Pareto fronts as a figure, and a table of what each setting buys, as Markdown and JSON."""

import json
import math
from pathlib import Path
from typing import Any

from rich.console import Console

from nrfgs_lab.bench.report import rows_from_records
from nrfgs_lab.bench.spec import Spec, rows_of
from nrfgs_lab.bench.table import Row, notes, plain_markdown, with_averages
from nrfgs_lab.tradeoff.analysis import (
    BY_NAME,
    COSTS,
    Change,
    changes,
    front_of,
    price,
)
from nrfgs_lab.tradeoff.figure import draw
from nrfgs_lab.tradeoff.plan import DEFAULT, Setting
from nrfgs_ns.files import write_whole

HEAD = ["", "seeds", "PSNR", "SSIM", "LPIPS", "training time", "FPS", "MB", "peak memory", "splats"]
RATIOS = ("time s", "FPS", "MB", "peak MB", "splats")
UNITS = {"time s": " s", "FPS": " FPS", "MB": " MB", "peak MB": " MB"}
"""What follows a number that stands where others are changes."""
WORDS = {
    "same": "unclear",
    "noise": "PSNR unclear",
    "gain": "gain, cost unclear",
    "loss": "loss, cost unclear",
    "better": "better and cheaper",
    "worse": "worse and dearer",
}


def report(spec: Spec, settings: list[Setting], out: Path, stale: dict[str, str]) -> None:
    """Write OUT/tradeoff.{md,json,png} from the records that are there, and print the table.

    Args:
        spec: the benchmark behind the sweep.
        settings: what its runs stand for.
        out: folder of the report; its runs/ holds the records.
        stale: names of records that are not to be used, with the reason.
    """
    rows = with_averages(rows_from_records(spec, out / "runs", stale))
    scenes = list(dict.fromkeys(row.scene for row in rows))
    default_strategy = next(strategy for strategy, run in rows_of(spec) if run.name == DEFAULT)
    results, texts, legend = [], [], list(LEGEND)
    for scene in scenes:
        of_scene = ordered([row for row in rows if row.scene == scene], settings)
        default = next(row for row in of_scene if row.run == DEFAULT and row.strategy == default_strategy)
        result = compare(of_scene, default, settings)
        results.append({"scene": scene, **result})
        texts.append(f"### {plain_markdown(scene)}\n\n{table(of_scene, default, result)}")
        if ABSOLUTE not in legend and any(is_absolute(row, default, name) for row in of_scene for name in UNITS):
            legend.append(ABSOLUTE)
    text = "\n".join([*texts, *(f"{note}\n" for note in [*legend, *notes(rows)])])
    write_whole(out / "tradeoff.md", text)
    write_whole(out / "tradeoff.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
    if any(row.records for row in rows):
        draw(rows, settings, out / "tradeoff.png")
    Console(soft_wrap=True, markup=False, highlight=False).print(text)
    print(f"Trade: {out / 'tradeoff.md'}, {out / 'tradeoff.png'}")


LEGEND = (
    "Changes are against the default; times, frames, bytes, memory and splats as factors. (Round brackets): within the "
    "noise, which is estimated from the spread over seeds, pooled over all settings of the scene, at 95 %; one "
    "comparison in twenty is wrong. [Square brackets]: too few seeds to tell.",
    "dB per doubling: what PSNR a doubling of that cost buys, or a halving loses. Unclear: not told from the default. "
    "★: on the Pareto front of the means, which knows no noise.",
)

ABSOLUTE = "Numbers with a unit are no factors: they stand as measured, where the default has none to compare with."


def ordered(rows: list[Row], settings: list[Setting]) -> list[Row]:
    """Rows in the order of the settings."""
    place = {setting.name: number for number, setting in enumerate(settings)}
    return sorted(rows, key=lambda row: place[row.run])


def compare(rows: list[Row], default: Row, settings: list[Setting]) -> dict[str, Any]:
    """All settings of one scene against the default, as plain data.

    Returns:
        "fronts": cost -> names by rising cost; "settings": for each its knob, value, seeds, means with deviations,
        changes with their noise (null if unknown), and prices by cost.
    """
    knobs = {setting.name: setting for setting in settings}
    names = ("PSNR", "SSIM", "LPIPS", *RATIOS)
    changed = {name: changes(rows, default, BY_NAME[name], name in RATIOS) for name in names}
    fronts = {cost.title: front_of(rows, cost) for cost in COSTS}
    result = []
    for row in rows:
        prices = {}
        for cost in COSTS:
            gain, paid = changed["PSNR"].get(row.run), changed[cost.column.name].get(row.run)
            if row is not default and gain is not None and paid is not None:
                prices[cost.title] = price(gain, paid, cost.power)
        result.append(
            {
                "knob": knobs[row.run].knob,
                "value": knobs[row.run].value,
                "run": row.run,
                "strategy": row.strategy,
                "seeds": sorted(row.records),
                "absent": {str(seed): why for seed, why in row.absent.items()},
                "values": {name: [row.mean(BY_NAME[name]), row.deviation(BY_NAME[name])] for name in names},
                "changes": {name: _plain(changed[name].get(row.run)) for name in names},
                "prices": prices,
            }
        )
    return {"fronts": fronts, "settings": result}


def _plain(change: Change | None) -> dict[str, Any] | None:
    if change is None:
        return None
    known = change.noise < math.inf
    return {"value": change.value, "noise": change.noise if known else None, "is_noise": change.is_noise}


def table(rows: list[Row], default: Row, result: dict[str, Any]) -> str:
    """One scene's table in Markdown: the default in absolute numbers, the settings as changes."""
    head = [*HEAD, *(f"dB per doubling of {cost.title}" for cost in COSTS)]
    lines = [head, ["---"] * 2 + ["---:"] * (len(head) - 2)]
    for row, plain in zip(rows, result["settings"], strict=True):
        if row is default:
            cells = [row.text(BY_NAME[name]) for name in ("PSNR", "SSIM", "LPIPS", *RATIOS)]
            prices = [""] * len(COSTS)
        else:
            cells = [
                row.text(BY_NAME[name]) + UNITS[name]
                if is_absolute(row, default, name)
                else change_text(plain["changes"][name], name)
                for name in ("PSNR", "SSIM", "LPIPS", *RATIOS)
            ]
            prices = [price_text(plain["prices"].get(cost.title)) for cost in COSTS]
        stars = [" ★" if row.run in result["fronts"][cost.title] else "" for cost in COSTS]
        prices = [(text + star).strip() for text, star in zip(prices, stars, strict=True)]
        name = plain_markdown(row.run)
        lines.append([f"**{name}**" if row is default else name, row.seeds, *cells, *prices])
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def is_absolute(row: Row, default: Row, name: str) -> bool:
    """Whether a cost is shown as measured: it is known, and there is none of the default to compare it with."""
    return name in UNITS and default.mean(BY_NAME[name]) is None and row.mean(BY_NAME[name]) is not None


def change_text(change: dict[str, Any] | None, name: str) -> str:
    """A change as the table shows it."""
    if change is None:
        return "-"
    value = change["value"]
    text = f"x {value:.2f}" if name in RATIOS else f"{value:+.2f}" if name == "PSNR" else f"{value:+.4f}"
    if not change["is_noise"]:
        return text
    return f"[{text}]" if change["noise"] is None else f"({text})"


def price_text(priced: tuple[str, float | None] | None) -> str:
    """A price as the table shows it."""
    if priced is None:
        return "-"
    kind, number = priced
    return f"{number:.2f}" if number is not None else WORDS[kind]
