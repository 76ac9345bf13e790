# SPDX-License-Identifier: Apache-2.0
"""What an author adds to a page: a tour and notes, from files that the page saves, or nerfstudio's camera paths."""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nrfgs_ns.errors import InputError, refusing, require

VIEWS_A_SECOND = 5
"""Views kept of a camera path; the page puts a smooth curve through them."""


def read_tour(words: Sequence[str], names: Sequence[str]) -> dict[str, Any] | None:
    """The page's "tour": "views", each a photograph's index or a camera (docs/web-interface.md); of a camera path also
    its "seconds", and whether it is a "loop". None without words.

    Args:
        words: of --tour: numbers, from 1, or names of photographs, or one JSON file.
        names: the photographs' names.
    """
    if not words:
        return None
    if len(words) == 1 and words[0].endswith(".json"):
        return _tour_in(Path(words[0]))
    if len(words) == 1:
        raise InputError(f"--tour {words[0]} names one photograph; a tour needs at least two.")
    return {"views": [_photograph(word, names) for word in words]}


def read_notes(file: Path | None) -> list[dict[str, Any]]:
    """Notes of a JSON file, {"notes": [{"text", "position", "camera" or none}, ...]}; without a file none."""
    if file is None:
        return []
    if not isinstance(notes := _json(file).get("notes"), list):
        raise InputError(f'{file} has no list "notes". "Save notes" in a page writes one.')
    for i, note in enumerate(notes):
        if not isinstance(note, dict) or not isinstance(note.get("text"), str):
            raise InputError(f'{file}: notes[{i}] has no "text". Give it a string.')
        _numbers(note.get("position"), 3, f"{file}: notes[{i}].position")
        if note.get("camera") is not None:
            _camera(note["camera"], f"{file}: notes[{i}].camera")
    return notes


def _photograph(word: str, names: Sequence[str]) -> int:
    if word in names:
        return names.index(word)
    if word.isdecimal() and 1 <= int(word) <= len(names):
        return int(word) - 1
    raise InputError(f"--tour {word}: no such photograph. Give 1 to {len(names)}, names like {names[0]}, or one .json.")


def _tour_in(file: Path) -> dict[str, Any]:
    content = _json(file)
    views = content.get("camera_path", content.get("tour"))
    if not isinstance(views, list) or len(views) < 2:
        raise InputError(f'{file} has no "tour" or "camera_path" of two views. "Save tour" in a page writes one.')
    if "camera_path" not in content:
        for i, view in enumerate(views):
            _camera(view, f"{file}: tour[{i}]")
        return {"views": views}
    if (kind := content.get("camera_type", "perspective")) != "perspective":
        raise InputError(f"{file}: camera_type is {kind}; a page shows perspective paths only.")
    (seconds,) = _numbers([content.get("seconds")], 1, f"{file}: seconds")
    require(seconds > 0, f"{file}: seconds", seconds, "positive")
    loop = bool(content.get("is_cycle", False))
    views = views + views[:1] if loop else views
    count = min(len(views), max(2, math.ceil(VIEWS_A_SECOND * seconds) + 1))
    kept = []
    for i in (round(k * (len(views) - 1) / (count - 1)) for k in range(count)):
        where = f"{file}: camera_path[{i}]"
        view = views[i] if isinstance(views[i], dict) else {}
        matrix = _numbers(view.get("camera_to_world"), 16, f"{where}.camera_to_world")
        columns = [matrix[4 * row + column] for column in range(4) for row in range(4)]
        kept.append({"matrix": columns, "fov": view.get("fov"), "aspect": view.get("aspect")})
        _camera(kept[-1], where)
    return {"views": kept, "seconds": seconds, "loop": loop}


def _camera(camera: Any, where: str) -> None:
    """Raise InputError unless it is a camera of the page's interface: a matrix, or a position and a target."""
    if not isinstance(camera, dict):
        raise InputError(f"{where} is no camera. Give it a position and a target.")
    if "matrix" in camera:
        axes = np.reshape(_numbers(camera["matrix"], 16, f"{where}.matrix"), (4, 4))[:3, :3]
        turns = np.abs(axes @ axes.T - np.eye(3)).max() < 1e-3 and np.linalg.det(axes) > 0
        if not turns or camera.get("position") or camera.get("target"):
            raise InputError(f"{where}: a matrix must stand alone, and be a rotation and a position. Correct it.")
    elif _numbers(camera.get("position"), 3, f"{where}.position") == _numbers(
        camera.get("target"), 3, f"{where}.target"
    ):
        raise InputError(f"{where}: target and position are equal. Move the target to what the camera looks at.")
    _numbers(camera.get("up") or [0, 0, 1], 3, f"{where}.up")
    for name, most, needed in (("fov", 180, "between 0 and 180 degrees"), ("aspect", math.inf, "positive")):
        if name in camera and not 0 < _numbers([camera[name]], 1, f"{where}.{name}")[0] < most:
            raise InputError(f"{where}.{name} is {camera[name]}; it must be {needed}.")


def _numbers(values: Any, count: int, where: str) -> list[float]:
    if isinstance(values, list) and len(values) == count:
        if all(isinstance(value, int | float) and abs(value) <= sys.float_info.max for value in values):
            return [float(f"{value:.7g}") for value in values]
    raise InputError(f"{where} must be {count} finite number{'s' if count > 1 else ''}, not {values}.")


def _json(file: Path) -> dict[str, Any]:
    with refusing(f"{file} cannot be read as JSON", "A page's Save button writes one.", OSError, ValueError):
        content = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise InputError(f"{file} holds no JSON object. A page's Save button writes one.")
    return content
