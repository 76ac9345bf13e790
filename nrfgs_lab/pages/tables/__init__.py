# SPDX-License-Identifier: Apache-2.0
"""The numbers of the pages, from the records in results/.

    python -m nrfgs_lab.pages.tables            # names the pages whose numbers are not those of the records
    python -m nrfgs_lab.pages.tables --write    # writes them anew

Between `<!-- table NAME -->` and `<!-- end -->` a page has the block of that name: a table on lines of its own, or a
number within a sentence; `NAME(bonsai, NRF-GS)` gives it arguments. `numbers.yaml` declares blocks that are numbers of
records; modules of this package compute the others, in their dictionary `BLOCKS`. A test holds pages and records
together, and asks that a number of decibels in the prose of such a page stands in one of its blocks.
"""

import importlib
import pkgutil
import re
from collections.abc import Callable, Iterator
from functools import cache

from nrfgs_lab.pages.tables.runs import ROOT
from nrfgs_lab.pages.tables.sheet import declared, rendered

OPENING = "<!-- table "
BLOCK = re.compile(r"<!-- table (\w+\.\w+)(\([^\n]*?\))? -->(.*?)<!-- end -->", re.DOTALL)


@cache
def blocks() -> dict[str, Callable[..., str]]:
    """Name of each block of the modules -> the function that returns its text."""
    names = [one.name for one in pkgutil.iter_modules(__path__) if not one.name.startswith("_")]
    modules = [importlib.import_module(f"{__name__}.{name}") for name in names]
    return {name: block for module in modules for name, block in getattr(module, "BLOCKS", {}).items()}


def pages():
    """The pages of this repository."""
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
        new = blocks()[name](*(words[1:-1].split(", ") if words else []))
    new = f"\n\n{new.strip()}\n\n" if old.startswith("\n") else new
    return f"{OPENING}{name}{words} -->{new}<!-- end -->"


def loose_decibels(text: str) -> Iterator[str]:
    """Numbers of decibels in a page's prose that stand in none of its blocks."""
    inside = " ".join(content for *_, content in BLOCK.findall(text))
    known = set(re.findall(r"\d+(?:\.\d+)?", inside))
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", BLOCK.sub("", text), flags=re.DOTALL)
    for number in re.findall(r"(?<![\d.])(\d+(?:\.\d+)?) dB", prose):
        if number not in known:
            yield number
