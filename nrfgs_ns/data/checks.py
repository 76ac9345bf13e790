# SPDX-License-Identifier: Apache-2.0
"""Checks of a data set before any training time is spent.

Every check raises InputError with the file or field, its content, and the fix. `source` is the file that messages name.
"""

import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.data.pictures import read_size
from nrfgs_ns.errors import InputError

SHOWN, LONGEST = 3, 160
"""Items that a message lists before it counts the rest, and characters of each."""


def warn(message: str) -> None:
    """Print a warning as plain text: brackets in a file name are not markup."""
    CONSOLE.print(f"Warning: {message}", style="bold yellow", markup=False, soft_wrap=True)


def some(items: Sequence[Any]) -> str:
    """The first few items for a message, and the number of the others."""
    rest = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(shown(str(item)) for item in items[:SHOWN]) + rest


def shown(value: Any) -> str:
    """A value from a file for a message: one printable line of bounded length."""
    text = value if isinstance(value, str) and value.isprintable() else ascii(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]}...{text[-LONGEST // 2 :]}"


def number(value: Any) -> float:
    """The value as a float; NaN if it is not a number."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def matrix(value: Any) -> np.ndarray:
    """The value as a float64 array; empty if it is ragged or not of numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def find_colmap(folder: Path) -> str | None:
    """Place of a COLMAP model in the folder of a data set."""
    for place in ("colmap/sparse/0", "sparse/0", "sparse", "."):
        if any((folder / place / f"cameras.{ending}").is_file() for ending in ("bin", "txt")):
            return place
    return None


def check_options(config: Any) -> None:
    """Check that the parser's numbers are in their ranges."""
    for name, least in (("scale_factor", 0), ("scene_scale", 0), ("downscale_factor", 1), ("eval_interval", 1)):
        value = getattr(config, name)
        if value is not None and not (0 < value < math.inf and value >= least):
            fix = "1 or more" if least else "a positive number"
            raise InputError(f"--{name.replace('_', '-')} is {value}. Give {fix}.")


def check_frames(frames: list[dict[str, Any]], source: Path) -> None:
    """Check that every frame names an image of its own, and that all frames or no frames name masks."""

    def without(key: str) -> list[int]:
        names = [frame.get(key) for frame in frames]
        return [row for row, name in enumerate(names) if not (isinstance(name, str) and name)]

    if nameless := [f"frames[{row}]" for row in without("file_path")]:
        raise InputError(f"{source}: {some(nameless)} without a file_path. Name the image, or remove the frame.")
    check_unique((os.path.normpath(frame["file_path"]) for frame in frames), f"{source}: frames")
    unmasked = [frames[row]["file_path"] for row in without("mask_path")]
    if unmasked and any("mask_path" in frame for frame in frames):
        fix = "Give one for every frame (an all-white mask keeps the whole image), or for none."
        raise InputError(f"{source}: mask_path is given for some frames but not for {some(unmasked)}. {fix}")


def check_unique(names: Iterable[Any], where: str) -> None:
    """Check that no name occurs twice; `where` begins the message."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{where} name {some(twice)} more than once. Keep one of each.")


def check_exist(paths: Sequence[Path], source: Path, what: str) -> None:
    """Check that every file exists; `what` is their kind."""
    missing = [path for path in paths if not os.path.isfile(path)]  # unlike Path's, False for a name too long
    if missing:
        fix = "Restore them, or correct their paths (with the extension) or --downscale-factor."
        raise InputError(f"{source}: {len(missing)} of {len(paths)} {what} are missing: {some(missing)}. {fix}")


def check_headers(paths: Sequence[Path], sizes: Sequence[tuple[int, int]], what: str, fix: str) -> None:
    """Check that every file is an image of the given size (width, height), by its header; `what` is their kind."""
    headers = [(path, read_size(path), tuple(size)) for path, size in zip(paths, sizes, strict=True)]
    wrong = [f"{path} is {w} x {h}, not {size[0]} x {size[1]}" for path, (w, h), size in headers if (w, h) != size]
    if wrong:
        raise InputError(f"{what}: {len(wrong)} do not match their cameras' (downscaled) size: {some(wrong)}. {fix}")
