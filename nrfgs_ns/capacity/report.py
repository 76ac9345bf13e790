# SPDX-License-Identifier: Apache-2.0
"""capacity.json: what a training has decided about its splats and their field, and by which evidence."""

import json
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


def add_to_report(folder: Path | None, entries: dict[str, Any]) -> None:
    """Write entries into the report; others stay. Nothing happens without a folder."""
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({**read_report(folder), **entries}, indent=1) + "\n"
    (folder / REPORT).write_text(text, encoding="utf-8")
