# SPDX-License-Identifier: Apache-2.0
"""The table of a benchmark: means and deviations over seeds, per scene and over scenes, as Markdown, CSV and LaTeX."""

import csv
import io
import math
import re
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from nrfgs_lab.bench.spec import AVERAGE

Record = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """One measured quantity."""

    name: str
    value: Callable[[Record], float | None]
    """its value in a run's record, None where there is none"""
    form: str
    """how it is written"""
    unit: float = 1.0
    """values are divided by this"""
    better: int = 0
    """1: more is better, -1: less is better, 0: no ranking"""
    is_time: bool = False
    """means something only for a run that had its GPU to itself, and beside others of the same machine"""
    in_files_only: bool = False
    """in the CSV and summary.json, not in the table that is read"""


def _in(part: str, key: str) -> Callable[[Record], float | None]:
    """A value of a record; None in those that an earlier version wrote without it."""
    return lambda record: record[part].get(key)


def _measured(part: str, key: str) -> Callable[[Record], float | None]:
    return lambda record: (record["measured"].get(part) or {}).get(key)


def _gap(record: Record) -> float | None:
    train, test = _measured("train", "psnr")(record), _measured("test", "psnr")(record)
    return None if train is None or test is None else train - test


COLUMNS = (
    Column("splats", _in("measured", "splats"), "{:,.0f}", better=-1),
    Column("time s", _in("train", "seconds"), "{:.1f}", better=-1, is_time=True),
    Column("SSIM", _measured("test", "ssim"), "{:.4f}", better=1),
    Column("MS-SSIM", _measured("test", "ms_ssim"), "{:.4f}", better=1),
    Column("LPIPS", _measured("test", "lpips"), "{:.4f}", better=-1),
    Column("FLIP", _measured("test", "flip"), "{:.4f}", better=-1),
    Column("L1", _measured("test", "l1"), "{:.4f}", better=-1),
    Column("PSNR", _measured("test", "psnr"), "{:.2f}", better=1),
    Column("cc PSNR", _measured("test", "cc_psnr"), "{:.2f}", better=1),
    Column("cc SSIM", _measured("test", "cc_ssim"), "{:.4f}", better=1),
    Column("FPS", _in("measured", "fps"), "{:.1f}", better=1, is_time=True),
    Column("FPS 1080p", _in("measured", "fps_1080p"), "{:.1f}", better=1, is_time=True),
    Column("MB", _in("measured", "parameter_bytes"), "{:.2f}", 1e6, better=-1),
    Column("ckpt MB", _in("measured", "checkpoint_bytes"), "{:.2f}", 1e6, better=-1),
    Column("peak MB", _in("train", "peak_memory_bytes"), "{:.1f}", 1e6, better=-1),
    Column("train PSNR", _measured("train", "psnr"), "{:.2f}"),
    Column("gap", _gap, "{:.2f}"),
    Column("cc MS-SSIM", _measured("test", "cc_ms_ssim"), "{:.4f}", better=1, in_files_only=True),
    Column("cc LPIPS", _measured("test", "cc_lpips"), "{:.4f}", better=-1, in_files_only=True),
    Column("cc L1", _measured("test", "cc_l1"), "{:.4f}", better=-1, in_files_only=True),
    Column("train cc PSNR", _measured("train", "cc_psnr"), "{:.2f}", in_files_only=True),
    Column("train SSIM", _measured("train", "ssim"), "{:.4f}", in_files_only=True),
    Column("train MS-SSIM", _measured("train", "ms_ssim"), "{:.4f}", in_files_only=True),
    Column("train LPIPS", _measured("train", "lpips"), "{:.4f}", in_files_only=True),
    Column("train L1", _measured("train", "l1"), "{:.4f}", in_files_only=True),
)
SHOWN = tuple(column for column in COLUMNS if not column.in_files_only)
"""The columns of the table that is read."""
MISSING, STALE, FAILED = "missing", "stale", "FAILED"
ABSENCES = (MISSING, STALE, FAILED)
"""Why a seed has no record, the gravest last."""


@dataclass
class Row:
    """One run under one strategy on one scene, or on the average of all."""

    scene: str
    run: str
    strategy: str
    records: dict[int, Record] = field(default_factory=dict)
    """seed -> record"""
    absent: dict[int, str] = field(default_factory=dict)
    """seed -> why there is no record, one of `ABSENCES`"""
    values: dict[str, dict[int, float]] = field(default_factory=dict)
    """column -> seed -> value"""
    devices: set[str] = field(default_factory=set)
    """what the records were made on"""

    def fill(self) -> "Row":
        """Read the columns' values from the records."""
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
        """How many seeds the row rests on, and what became of the others."""
        reasons = [f"{list(self.absent.values()).count(why)} {why}" for why in dict.fromkeys(self.absent.values())]
        return f"{len(self.records)}" + (f" ({', '.join(reasons)})" if reasons else "")

    def text(self, column: Column) -> str:
        """The cell without emphasis."""
        mean, deviation = self.mean(column), self.deviation(column)
        if mean is None:
            return "-"
        return column.form.format(mean) + (f" ± {column.form.format(deviation)}" if deviation is not None else "")


def average(rows: list[Row]) -> Row:
    """The row of means over scenes: seed by seed, of the seeds and columns that every scene has."""
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
    """The rows, and behind them one average for each run and strategy if there is more than one scene."""
    kinds = list(dict.fromkeys((row.strategy, row.run) for row in rows))
    if len({row.scene for row in rows}) < 2:
        return rows
    return rows + [average([row for row in rows if (row.strategy, row.run) == kind]) for kind in kinds]


def ranks(rows: list[Row], column: Column) -> dict[int, int]:
    """Row number -> 1 (best) or 2 (second) among rows that can be compared; equal as written is equal.

    Args:
        rows: those of one scene and strategy. Times are ranked only if all are of one machine.
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


def has_run(row: Row) -> bool:
    """Whether there is anything to say of a row: a record, a failure, or a record that cannot be used."""
    return bool(row.records) or any(why != MISSING for why in row.absent.values())


def cells(rows: list[Row], best: Callable[[str], str], second: Callable[[str], str]) -> list[list[str]]:
    """The body of the table that is read; best and second of each scene and strategy are marked.

    Rows of which nothing was run are left out; `not_run` names them.
    """
    body: list[list[str]] = []
    shown = [row for row in rows if has_run(row)]
    for place in dict.fromkeys((row.scene, row.strategy) for row in shown):
        group = [row for row in shown if (row.scene, row.strategy) == place]
        ranked = {column.name: ranks(group, column) for column in SHOWN}
        for number, row in enumerate(group):
            line = [row.scene, row.run, row.strategy, row.seeds]
            for column in SHOWN:
                mark = {1: best, 2: second}.get(ranked[column.name].get(number), str)
                line.append(mark(row.text(column)))
            body.append(line)
    return body


HEAD = ["scene", "run", "strategy", "seeds"]


def notes(rows: list[Row]) -> list[str]:
    """Sentences that must stand below the table."""
    records = [record for row in rows if row.scene != AVERAGE for record in row.records.values()]
    result = []
    if any(record["jobs"] != 1 for record in records):
        result.append("Time and FPS are left out (-) of runs that shared their GPU with others.")
    if any(record["train"].get("parts", 1) > 1 for record in records):
        result.append("Some runs were interrupted and went on from a checkpoint; their times are sums.")
    if any(row.absent for row in rows):
        result.append(
            "Runs that failed, are missing or were made with other arguments (stale) are counted under seeds."
        )
    thin = [one.name for one in COLUMNS if any(0 < len(row.values[one.name]) < len(row.records) for row in rows)]
    if thin:
        result.append(f"Some numbers rest on fewer seeds than their row, on those that have them: {', '.join(thin)}.")
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


def not_run(rows: list[Row]) -> list[str]:
    """A sentence that names the rows of which nothing was run, if there are any."""
    places: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row.scene != AVERAGE and not has_run(row):
            places.setdefault((row.scene, row.strategy), []).append(row.run)
    listed = "; ".join(f"{scene}, {strategy}: {', '.join(runs)}" for (scene, strategy), runs in places.items())
    return [f"Not run yet, and in no row: {listed}."] if listed else []


def markdown(rows: list[Row]) -> str:
    """The table in Markdown: best bold, second in italics."""
    head = HEAD + [column.name for column in SHOWN]
    body = cells(rows, lambda text: f"**{text}**", lambda text: f"_{text}_")
    body = [[*map(plain_markdown, line[: len(HEAD)]), *line[len(HEAD) :]] for line in body]
    lines = [head, ["---"] * len(HEAD) + ["---:"] * len(SHOWN), *body]
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return text + "".join(f"\n{note}\n" for note in [*map(plain_markdown, not_run(rows)), *notes(rows)])


def plain_markdown(text: str) -> str:
    """A name as Markdown writes it out, in a cell of a table. An underscore between letters is one."""
    return re.sub(r"[\\`*|<\[]|(?<!\w)_|_(?!\w)", r"\\\g<0>", " ".join(text.split()))


def latex(rows: list[Row]) -> str:
    """The table as a LaTeX tabular: best bold, second underlined, a line between scenes and strategies; notes below."""
    body = cells(rows, lambda text: f"\\textbf{{{text}}}", lambda text: f"\\underline{{{text}}}")
    lines = [f"\\begin{{tabular}}{{{'l' * len(HEAD)}{'r' * len(SHOWN)}}}", "\\hline"]
    lines.append(" & ".join([*HEAD, *(column.name for column in SHOWN)]) + r" \\")
    place = None
    for line in body:
        if (line[0], line[2]) != place:
            lines.append("\\hline")
        place = line[0], line[2]
        escaped = [_escaped(word) for word in line[: len(HEAD)]]
        numbers = [re.sub(r"-(?=\d)", "$-$", word).replace("±", r"$\pm$") for word in line[len(HEAD) :]]
        lines.append(" & ".join([*escaped, *numbers]) + r" \\")
    lines += ["\\hline", "\\end{tabular}"]
    lines += [f"\n\\noindent {_escaped(note)}" for note in [*not_run(rows), *notes(rows)]]
    return "\n".join(lines) + "\n"


LATEX = {
    **{letter: f"\\{letter}" for letter in "_&%#${}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"},
    **{letter: f"{{{letter}}}" for letter in "[*"},
}
"""Letter -> what writes it out. Behind a line's end `[` and `*` would be read as its arguments."""


def _escaped(text: str) -> str:
    escaped = "".join(LATEX.get(letter, letter) for letter in " ".join(text.split()))
    return re.sub(r"-(?=-)", "-{}", escaped)  # two would be printed as a dash


def as_csv(rows: list[Row]) -> str:
    """Means and deviations as plain numbers, empty where there is none; all rows, and numbers of absent seeds."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    titles = [title for column in COLUMNS for title in (column.name, f"{column.name} deviation")]
    writer.writerow([*HEAD, *ABSENCES, *titles])
    for row in rows:
        counts = [len(row.records), *(list(row.absent.values()).count(why) for why in ABSENCES)]
        numbers = [number for column in COLUMNS for number in (row.mean(column), row.deviation(column))]
        writer.writerow([row.scene, row.run, row.strategy, *counts, *("" if n is None else n for n in numbers)])
    return file.getvalue()


PER_VIEW = {
    **{"PSNR": "psnr", "SSIM": "ssim", "MS-SSIM": "ms_ssim", "LPIPS": "lpips", "L1": "l1"},
    **{"FLIP": "flip", "cc PSNR": "cc_psnr", "cc SSIM": "cc_ssim"},
}
"""Column -> its key in a view's measurement."""


def views_as_csv(rows: list[Row]) -> str:
    """The metrics of every test view, a line for each run, seed and view: one bad view of a few moves a mean far."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*HEAD[:3], "seed", "image", *PER_VIEW])
    for row in rows:
        for seed, record in sorted(row.records.items()):
            for view in (record["measured"].get("test") or {}).get("per_image", ()):
                numbers = (view.get(key) for key in PER_VIEW.values())
                place = (row.scene, row.run, row.strategy, seed, view["image"])
                writer.writerow([*place, *("" if n is None else f"{n:.6g}" for n in numbers)])
    return file.getvalue()
