# SPDX-License-Identifier: Apache-2.0
"""The numbers of the pages, from the records in results/.

    python -m nrfgs_lab.pages.tables            # names the pages whose numbers are not those of the records
    python -m nrfgs_lab.pages.tables --write    # writes them anew

Between `<!-- table NAME -->` and `<!-- end -->` a page has the block of that name: a table on lines of its own, or a
number within a sentence; `NAME(bonsai, NRF-GS)` gives it arguments. `numbers.yaml` declares blocks that are numbers of
records; `BLOCKS` of the modules beside this one compute the others. A test holds pages and records together, and asks
that a number of decibels in the prose of such a page stands in one of its blocks.
"""

import operator
import re
import sys
from collections.abc import Callable
from functools import cache
from statistics import fmean, median
from typing import Any

import yaml

from nrfgs_lab.pages import appendix, few_views, files, methods, others, speed
from nrfgs_lab.pages.runs import ROOT, bench_rows, grid, records, signed

OPENING = "<!-- table "
BLOCK = re.compile(r"<!-- table (\w+\.\w+)(\([^\n]*?\))? -->(.*?)<!-- end -->", re.DOTALL)
BLOCKS = appendix.BLOCKS | few_views.BLOCKS | files.BLOCKS | methods.BLOCKS | others.BLOCKS | speed.BLOCKS
SHEET = ROOT / "nrfgs_lab" / "pages" / "numbers.yaml"
AGGREGATES: dict[str, Callable] = {"min": min, "max": max, "mean": fmean, "median": median}
OPERATORS = {"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv}
FORMS: dict[str, Callable[[Any], str]] = {
    "signed": lambda number: signed(number, 2),
    "MB": lambda number: f"{number / 1e6:.{1 if number > 1e7 else 2}f}",
    "size": lambda number: f"{number / 1000:,.0f} KB" if number < 1e6 else f"{number / 1e6:.1f} MB",
}
"""Forms beside Python's."""


def pages():
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def written(text: str) -> str:
    """A page's text with its blocks as the records have them."""
    if text.count(OPENING) != len(BLOCK.findall(text)):
        raise ValueError("A block has no end, or its name is not PAGE.NAME.")
    return BLOCK.sub(_block, text)


def _block(match: re.Match) -> str:
    name, words, old = match.groups(default="")
    if name + words in declared():
        new = rendered(declared()[name + words])
    else:
        new = BLOCKS[name](*(words[1:-1].split(", ") if words else []))
    new = f"\n\n{new.strip()}\n\n" if old.startswith("\n") else new
    return f"{OPENING}{name}{words} -->{new}<!-- end -->"


# Blocks that numbers.yaml declares.


@cache
def declared() -> dict[str, Any]:
    """Name of a block, perhaps with arguments in brackets -> its text or table."""
    return yaml.safe_load(SHEET.read_text(encoding="utf-8"))


def rendered(block: Any) -> str:
    if isinstance(block, str):
        return filled(block)
    body = []
    for label, row in block["rows"].items():
        texts = row
        if "cell" in block:
            texts = [block["cell"].replace("$row", row).replace("$column", column) for column in block["columns"]]
        body.append([label, *map(filled, texts)])
    return grid([title.strip() for title in filled(block["head"]).split("|")], body)


def filled(template: str) -> str:
    """A template with its numbers."""
    return re.sub(r"\{([^{}]*):([^{}:]*)\}", lambda match: formatted(term(match[1]), match[2]), template)


def term(words: str) -> Any:
    """The value of terms joined by operators, from left to right."""
    first, *rest = re.split(r" ([-+*/]) ", words)
    value = single(first)
    for sign, other in zip(rest[::2], map(single, rest[1::2]), strict=True):
        value = OPERATORS[sign](value, other)
    return value


def single(words: str) -> Any:
    """A number, or the value at a path of a record."""
    study, *path = words.strip().split("|")
    if not path:
        return float(study)
    value: Any = records(study)
    if path[0] == "rows":  # of a benchmark: SCENE/STRATEGY/RUN, column, seed
        value, path = {"/".join(place): row.values for place, row in bench_rows(study).items()}, path[1:]
    for key in path:
        value = step(value, key)
    return value


def step(value: Any, key: str) -> Any:
    """The value one key further down."""
    if isinstance(value, dict) and key in value:
        return value[key]
    what, _, inner = key.partition(" ")
    if what in AGGREGATES:
        every = value.values() if isinstance(value, dict) else value
        return AGGREGATES[what]([step(one, inner) if inner else one for one in every])
    if isinstance(value, list) and "=" in key:
        pairs = [pair.split("=") for pair in key.split("&")]
        return next(one for one in value if all(str(one[name]) == wanted for name, wanted in pairs))
    return value[int(key)] if isinstance(value, list) else value[key]


def formatted(value: Any, form: str) -> str:
    return FORMS[form](value) if form in FORMS else format(value, form)


def main(write: bool) -> None:
    """Check the pages, or write them; ends with status 1 if one differs."""
    stale = [page for page in pages() if written(page.read_text(encoding="utf-8")) != page.read_text(encoding="utf-8")]
    for page in stale:
        if write:
            page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")
        print(page.relative_to(ROOT), "written" if write else "differs from the records; --write writes it")
    sys.exit(1 if stale and not write else 0)


if __name__ == "__main__":
    main("--write" in sys.argv[1:])
