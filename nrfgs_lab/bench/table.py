# SPDX-License-Identifier: Apache-2.0
"""The table of a benchmark: means and deviations over seeds, per scene and over scenes, as Markdown."""

import math
import re
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from nrfgs_lab.bench.spec import AVERAGE

Record = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """One measured quantity."""

    name: str
    value: Callable[[Record], float | None]  # value in a run's record, or None
    form: str  # format
    better: int = 0  # 1: more is better, -1: less is better, 0: no ranking
    unit: float = 1.0  # values are divided by this
    is_time: bool = False  # valid only for runs alone on their GPU, and comparable on one machine


def _at(*keys: str) -> Callable[[Record], float | None]:
    """Value of nested keys; None if one is missing or null."""

    def value(record: Record) -> float | None:
        for key in keys:
            record = record.get(key)
            if record is None:
                return None
        return record

    return value


def _gap(record: Record) -> float | None:
    train, test = _at("measured", "train", "psnr")(record), _at("measured", "test", "psnr")(record)
    return None if train is None or test is None else train - test


def _metric(name: str, form: str = "{:.4f}", better: int = 1) -> Column:
    return Column(name, _at("measured", "test", re.sub("[- ]", "_", name.lower())), form, better)


COLUMNS = (
    Column("splats", _at("measured", "splats"), "{:,.0f}", -1),
    Column("time s", _at("train", "seconds"), "{:.1f}", -1, is_time=True),
    *(_metric("SSIM"), _metric("MS-SSIM"), _metric("LPIPS", better=-1), _metric("FLIP", better=-1)),
    _metric("L1", better=-1),
    *(_metric("PSNR", "{:.2f}"), _metric("cc PSNR", "{:.2f}"), _metric("cc SSIM")),
    Column("FPS", _at("measured", "fps"), "{:.1f}", 1, is_time=True),
    Column("FPS 1080p", _at("measured", "fps_1080p"), "{:.1f}", 1, is_time=True),
    Column("MB", _at("measured", "parameter_bytes"), "{:.2f}", -1, 1e6),
    Column("ckpt MB", _at("measured", "checkpoint_bytes"), "{:.2f}", -1, 1e6),
    Column("peak MB", _at("train", "peak_memory_bytes"), "{:.1f}", -1, 1e6),
    Column("train PSNR", _at("measured", "train", "psnr"), "{:.2f}"),
    Column("gap", _gap, "{:.2f}"),
)
BY_NAME = {column.name: column for column in COLUMNS}
MISSING, STALE, FAILED = "missing", "stale", "FAILED"
ABSENCES = (MISSING, STALE, FAILED)
"""Reasons for a missing record, the gravest last."""


@dataclass
class Row:
    """A run under a strategy on a scene, or on the average of all."""

    scene: str
    run: str
    strategy: str
    records: dict[int, Record] = field(default_factory=dict)  # seed -> record
    absent: dict[int, str] = field(default_factory=dict)  # seed -> one of `ABSENCES`
    values: dict[str, dict[int, float]] = field(default_factory=dict)  # column -> seed -> value
    devices: set[str] = field(default_factory=set)  # machines of the records

    def fill(self) -> "Row":
        """Set the columns' values from the records."""
        for column in COLUMNS:
            values = {}
            for seed, record in self.records.items():
                value = column.value(record)
                is_number = value is not None and math.isfinite(value)
                if is_number and not (column.is_time and record["jobs"] != 1):
                    values[seed] = value / column.unit
            self.values[column.name] = values
        self.devices = {record["machine"].get("device", "unknown") for record in self.records.values()}
        return self

    def mean(self, column: Column) -> float | None:
        values = self.values[column.name].values()
        return statistics.fmean(values) if values else None

    def deviation(self, column: Column) -> float | None:
        """Sample deviation over seeds."""
        values = self.values[column.name].values()
        return statistics.stdev(values) if len(values) > 1 else None

    @property
    def seeds(self) -> str:
        """Number of seeds with a record, and reasons for the missing ones."""
        reasons = [f"{list(self.absent.values()).count(why)} {why}" for why in dict.fromkeys(self.absent.values())]
        return f"{len(self.records)}" + (f" ({', '.join(reasons)})" if reasons else "")

    def text(self, column: Column) -> str:
        """The cell without emphasis."""
        mean, deviation = self.mean(column), self.deviation(column)
        if mean is None:
            return "-"
        return column.form.format(mean) + (f" ± {column.form.format(deviation)}" if deviation is not None else "")


def average(rows: list[Row]) -> Row:
    """Means over scenes, of seeds and columns that every scene has."""
    result = Row(AVERAGE, rows[0].run, rows[0].strategy)
    seeds = [seed for seed in rows[0].records if all(seed in row.records for row in rows)]
    result.records = {seed: {} for seed in seeds}
    for row in rows:
        for seed, why in row.absent.items():
            result.absent[seed] = max(why, result.absent.get(seed, MISSING), key=ABSENCES.index)
        result.devices |= row.devices
    for column in COLUMNS:
        shared = [seed for seed in seeds if all(seed in row.values[column.name] for row in rows)]
        result.values[column.name] = {
            seed: statistics.fmean(row.values[column.name][seed] for row in rows) for seed in shared
        }
    return result


def with_averages(rows: list[Row]) -> list[Row]:
    """Rows, followed by an average for each run and strategy that has all scenes, if there are several."""
    kinds = dict.fromkeys((row.strategy, row.run) for row in rows)
    scenes = {row.scene for row in rows}
    of_kinds = [[row for row in rows if (row.strategy, row.run) == kind] for kind in kinds]
    return rows + [average(of_kind) for of_kind in of_kinds if len(of_kind) == len(scenes) > 1]


def ranks(rows: list[Row], column: Column) -> dict[int, int]:
    """Row number -> 1 (best) or 2 (second) within a scene and strategy; values are compared as printed.

    Times are ranked only if all were taken on one machine.
    """
    if column.better == 0:
        return {}
    shown = {
        number: column.form.format(row.mean(column)) for number, row in enumerate(rows) if row.mean(column) is not None
    }
    if column.is_time and len(set().union(*(rows[number].devices for number in shown))) > 1:
        return {}
    order = sorted(shown, key=lambda number: -column.better * rows[number].mean(column))
    distinct = list(dict.fromkeys(shown[number] for number in order))
    if len(distinct) < 2:
        return {}
    return {number: distinct.index(text) + 1 for number, text in shown.items() if text in distinct[:2]}


HEAD = ["scene", "run", "strategy", "seeds"]


def notes(rows: list[Row]) -> list[str]:
    """Sentences below the table."""
    records = [record for row in rows if row.scene != AVERAGE for record in row.records.values()]
    result = []
    if any(record["jobs"] != 1 for record in records):
        result.append("Time and FPS are left out (-) of runs that shared their GPU with others.")
    if any(record["train"].get("parts", 1) > 1 for record in records):
        result.append("Some runs were interrupted and went on from a checkpoint; their times are sums.")
    if any(row.absent for row in rows):
        result.append("Runs that failed, are missing or had other arguments (stale) are counted under seeds.")
    thin = [one.name for one in COLUMNS if any(0 < len(row.values[one.name]) < len(row.records) for row in rows)]
    if thin:
        result.append(f"Some numbers rest on fewer seeds than their row, on those that have them: {', '.join(thin)}.")
    budgets = [(row, re.search(r"(?:@|\bbudget=)(\d+)", row.strategy)) for row in rows]
    if over := [row.run for row, most in budgets if most and (row.mean(BY_NAME["splats"]) or 0) > int(most[1])]:
        result.append(f"More splats than the budget, since they began with more: {', '.join(dict.fromkeys(over))}.")
    timed = [row.devices for row in rows if any(row.values[column.name] for column in COLUMNS if column.is_time)]
    if len(set().union(*timed)) > 1:
        result.append("Times and FPS were taken on different machines; none is marked beside those of another.")
    machines = dict.fromkeys(
        ", torch ".join(record["machine"].get(key, "unknown") for key in ("device", "torch")) for record in records
    )
    if machines:
        result.append(f"Made on: {'; '.join(machines)}.")
    sources = {record["machine"].get("source", "unknown") for record in records}
    if len(sources) > 1:
        result.append("Not all were made with the same version of this package: `machine.source` of each record.")
    return result


def markdown(rows: list[Row]) -> str:
    """Markdown table: best of each scene and strategy bold, second in italics."""
    body = []
    mark = {1: "**{}**", 2: "_{}_"}
    for place in dict.fromkeys((row.scene, row.strategy) for row in rows):
        group = [row for row in rows if (row.scene, row.strategy) == place]
        ranked = {column.name: ranks(group, column) for column in COLUMNS}
        for number, row in enumerate(group):
            cells = [mark.get(ranked[one.name].get(number), "{}").format(row.text(one)) for one in COLUMNS]
            body.append([*map(plain_markdown, [row.scene, row.run, row.strategy, row.seeds]), *cells])
    return "\n\n".join([grid(HEAD + [column.name for column in COLUMNS], body, len(HEAD)), *notes(rows)]) + "\n"


def grid(head: Sequence[str], rows: Iterable[Sequence[str]], left: int | None = None) -> str:
    """A table in Markdown, without the last line's end; columns after the first `left` are aligned to the right."""
    lines = [head, ["---" if left is None or i < left else "---:" for i in range(len(head))], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def plain_markdown(text: str) -> str:
    """Text escaped for a cell of a Markdown table; an underscore between letters needs no escape."""
    return re.sub(r"[\\`*|<\[]|(?<!\w)_|_(?!\w)", r"\\\g<0>", " ".join(text.split()))
