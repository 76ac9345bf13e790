# SPDX-License-Identifier: Apache-2.0
"""The numbers of the pages, from the records in results/.

    python -m nrfgs_lab.pages.tables            # names the pages whose numbers are not those of the records
    python -m nrfgs_lab.pages.tables --write    # writes them anew

Between `<!-- table MODULE.FUNCTION -->` and `<!-- end -->` a page has what the function of that module of this package
returns: a table on lines of its own, or a number within a sentence. `MODULE.FUNCTION(bonsai, NRF-GS)` hands it words. A
test holds pages and records together, and asks that a number of decibels in the prose of such a page stands in one of
its blocks.
"""

import importlib
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from nrfgs_lab.bench.table import COLUMNS, Row

ROOT = Path(__file__).resolve().parents[3]
OPENING = "<!-- table "
BLOCK = re.compile(r"<!-- table (\w+)\.(\w+)(\([^\n]*?\))? -->(.*?)<!-- end -->", re.DOTALL)
RUN = re.compile(r"runs/(?P<run>.+)-(?P<strategy>own|original|mcmc@\d+)-(?P<scene>[^-]+)-(?P<seed>\d+)")
"""How a benchmark names its records. An underscore stands for a space."""
BY_NAME = {column.name: column for column in COLUMNS}


def pages() -> list[Path]:
    """The pages of this repository."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def written(text: str) -> str:
    """A page's text with its blocks as the records have them."""
    if text.count(OPENING) != len(BLOCK.findall(text)):
        raise ValueError("A block has no end, or its name is not MODULE.FUNCTION.")
    return BLOCK.sub(_block, text)


def _block(match: re.Match) -> str:
    module, function, words, old = match.groups(default="")
    arguments = words[1:-1].split(", ") if words else []
    new = getattr(importlib.import_module(f"{__name__}.{module}"), function)(*arguments)
    new = f"\n\n{new.strip()}\n\n" if old.startswith("\n") else new
    return f"{OPENING}{module}.{function}{words} -->{new}<!-- end -->"


@cache
def records(study: str) -> dict[str, Any]:
    """The records of results/STUDY.json."""
    content = json.loads((ROOT / "results" / f"{study}.json").read_text(encoding="utf-8"))
    return content.get("records", content)


def grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@cache
def bench_rows(study: str) -> dict[tuple[str, str, str], Row]:
    """The rows of a benchmark's file in results/: (scene, strategy, run) -> its values over seeds."""
    rows: dict[tuple[str, str, str], Row] = {}
    for name, record in records(study).items():
        match = RUN.fullmatch(name)
        if match:
            scene, strategy, run = match["scene"], match["strategy"], match["run"]
            row = rows.setdefault((scene, strategy, run), Row(scene, run, strategy))
            row.records[int(match["seed"])] = {"jobs": 1, **record}
    return {place: row.fill() for place, row in rows.items()}


def bold(text: str, condition: bool = True) -> str:
    """Bold in Markdown, on a condition."""
    return f"**{text}**" if condition else text


def signed(difference: float, digits: int = 1) -> str:
    """A difference with its sign; without one if it rounds to nothing."""
    text = f"{difference:+.{digits}f}"
    return text if float(text) else text[1:]


def mean_of(row: Row, column: str) -> float:
    """A row's mean over seeds.

    Raises:
        KeyError: no record of the row has it.
    """
    mean = row.mean(BY_NAME[column])
    if mean is None:
        raise KeyError(f"{row.run} on {row.scene} has no {column}.")
    return mean


def loose_decibels(text: str) -> Iterator[str]:
    """Numbers of decibels in a page's prose that stand in none of its blocks."""
    blocks = " ".join(match[3] for match in BLOCK.findall(text))
    known = set(re.findall(r"\d+(?:\.\d+)?", blocks))
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", BLOCK.sub("", text), flags=re.DOTALL)
    for number in re.findall(r"(?<![\d.])(\d+(?:\.\d+)?) dB", prose):
        if number not in known:
            yield number
