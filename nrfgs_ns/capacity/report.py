# SPDX-License-Identifier: Apache-2.0
"""capacity.json: what a training has decided about its splats and their field, and by which evidence."""

import json
import math
from pathlib import Path
from typing import Any

REPORT = "capacity.json"
"""Beside config.yml."""


def read_report(folder: Path | None) -> dict[str, Any]:
    """What has been written so far; nothing where there is no file, or no folder."""
    path = None if folder is None else folder / REPORT
    return json.loads(path.read_text(encoding="utf-8")) if path is not None and path.exists() else {}


def forget_report(folder: Path | None) -> None:
    """Take away what an earlier training in this folder has decided."""
    if folder is not None:
        (folder / REPORT).unlink(missing_ok=True)


def continue_report(folder: Path | None, earlier: Path | None, start: int) -> None:
    """Begin the report of a continued training with what was decided before it, unless there is one already.

    Args:
        folder: of the training.
        earlier: of the one whose checkpoint it goes on from.
        start: its first step.
    """
    found = read_report(earlier)
    if folder is None or not found or (folder / REPORT).exists():
        return
    if "looks" in found:
        found["looks"] = [look for look in found["looks"] if look["step"] < start]
    if found.get("step", -1) >= start:  # of capacity auto; decided after the checkpoint was written
        found = {"looks": found["looks"]} if "looks" in found else {}
    if found:
        add_to_report(folder, found)


def add_to_report(folder: Path | None, entries: dict[str, Any]) -> None:
    """Write entries into the report; others stay. Nothing happens without a folder."""
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_numbers_only({**read_report(folder), **entries}), indent=1, allow_nan=False) + "\n"
    (folder / REPORT).write_text(text, encoding="utf-8")


def _numbers_only(content: Any) -> Any:
    """The same with null for what JSON has no number for."""
    if isinstance(content, dict):
        return {name: _numbers_only(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_numbers_only(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
