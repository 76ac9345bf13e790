# SPDX-License-Identifier: Apache-2.0
"""A COLMAP model, binary or text, read without trusting what it says of its own lengths.

The format is https://colmap.github.io/format.html. A file that cannot be read raises InputError. What is read is at
most as large as the file: a count in it is believed as far as there are bytes for it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat

from nrfgs_ns.data.checks import shown
from nrfgs_ns.errors import InputError

MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fl_x", "fl_y", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")),
    5: ("OPENCV_FISHEYE", ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")),
    8: ("SIMPLE_RADIAL_FISHEYE", ("f", "cx", "cy", "k1")),
    9: ("RADIAL_FISHEYE", ("f", "cx", "cy", "k1", "k2")),
}
"""Camera models that can be undistorted: COLMAP's number, name, and parameters as transforms.json names them."""
BY_NAME = dict(MODELS.values())
QUATERNION_TOLERANCE = 1e-2
"""How far a rotation's quaternion may be from unit length."""
DAMAGED = (struct.error, OSError, ValueError, IndexError, KeyError, MemoryError, OverflowError)
"""What reading a damaged file raises."""


class View(NamedTuple):
    """One photograph of a model."""

    id: int
    name: str
    camera: int
    world_to_camera: np.ndarray
    """float64 [4, 4], y down, z forwards"""


def read_model(folder: Path) -> tuple[dict[int, dict[str, Any]], list[View], Path]:
    """The cameras and photographs of a model.

    Args:
        folder: with cameras and images, .bin or .txt; text comes first, as in nerfstudio.

    Returns:
        Cameras by id (camera_model, w, h and parameters, named as in transforms.json), the photographs by id, and the
        file of the photographs, for messages.

    Raises:
        InputError: a file is missing or damaged, or has a camera model that cannot be undistorted.
    """
    ending = next((end for end in ("txt", "bin") if (folder / f"cameras.{end}").is_file()), None)
    if ending is None:
        raise InputError(f"{folder} holds neither cameras.bin nor cameras.txt. {_where_is_the_model(folder)}")
    cameras_file, images_file = folder / f"cameras.{ending}", folder / f"images.{ending}"
    read = (_cameras_bin, _images_bin) if ending == "bin" else (_cameras_txt, _images_txt)
    cameras = _guarded(read[0], cameras_file)
    views = sorted(_guarded(read[1], images_file))
    if not views:
        raise InputError(f"{images_file} holds no photograph. Export the COLMAP model again.")
    strangers = [view.name for view in views if view.camera not in cameras]
    if strangers:
        raise InputError(
            f"{images_file}: {shown(strangers[0])} has a camera that {cameras_file.name} lacks. Export the COLMAP "
            "model again."
        )
    return cameras, views, images_file


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray, Path]:
    """Positions and colours, float64 [N, 3] each, of points3D.bin or points3D.txt, and the file."""
    path = next((folder / f"points3D.{end}" for end in ("bin", "txt") if (folder / f"points3D.{end}").is_file()), None)
    if path is None:
        raise InputError(f"{folder} holds neither points3D.bin nor points3D.txt. Restore one, or remove the folder.")
    table = _guarded(_points_bin if path.suffix == ".bin" else _points_txt, path)
    return table[:, :3], table[:, 3:], path


def _where_is_the_model(folder: Path) -> str:
    """Where a model is that was looked for in `folder`, somewhere below the same data set."""
    root = next((parent for parent in folder.parents if parent.is_dir()), folder)
    for place in ("colmap/sparse/0", "sparse/0", "sparse", "."):
        if any((root / place / f"cameras.{end}").is_file() for end in ("bin", "txt")):
            return f"There is a COLMAP model in {root / place}: give --colmap-path."
    return "Name the folder of the COLMAP model with --colmap-path."


def _guarded(read: Callable[[Path], Any], path: Path) -> Any:
    if not path.is_file():
        raise InputError(f"{path} is missing. Export the COLMAP model again.")
    try:
        return read(path)
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(f"{path} cannot be read ({error}). Export the COLMAP model again.") from error


def _camera(model: str, width: int, height: int, parameters: list[float], path: Path) -> dict[str, Any]:
    names = BY_NAME.get(model)
    if names is None:
        raise InputError(
            f"{path}: camera model {shown(model)} is not supported. Undistort the photographs (colmap "
            f"image_undistorter), or use one of {', '.join(BY_NAME)}."
        )
    if len(parameters) != len(names):
        raise ValueError(f"a {model} camera with {len(parameters)} parameters instead of {len(names)}")
    values = dict(zip(names, parameters, strict=True))
    if "f" in values:
        values["fl_x"] = values["fl_y"] = values.pop("f")
    kind = "OPENCV_FISHEYE" if "FISHEYE" in model else "OPENCV"
    return {"camera_model": kind, "w": width, "h": height, **values}


def _view(id: int, rotation: list[float], translation: list[float], camera: int, name: str, path: Path) -> View:
    quaternion = np.array(rotation)
    pose = np.eye(4)
    pose[:3, 3] = translation

    def reject(finding: str) -> NoReturn:
        raise InputError(f"{path}: the pose of {shown(name)} {finding}. Export the COLMAP model again.")

    if not (np.isfinite(quaternion).all() and np.isfinite(pose).all()):
        reject("holds NaN or Inf")
    if abs(np.linalg.norm(quaternion) - 1) > QUATERNION_TOLERANCE:
        reject(f"has a quaternion of length {np.linalg.norm(quaternion):.3g} instead of 1")
    pose[:3, :3] = qvec2rotmat(quaternion)
    return View(id, name, camera, pose)


# Binary.


class _Bytes:
    """A file's bytes, read from front to back; struct.error at the end."""

    def __init__(self, path: Path):
        self.data, self.at = path.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def skip(self, count: int) -> None:
        if count > len(self.data) - self.at:
            raise ValueError(f"{count} bytes are announced and {len(self.data) - self.at} are there")
        self.at += count

    def end(self) -> None:
        if self.at != len(self.data):
            raise ValueError(f"{len(self.data) - self.at} bytes follow the last entry")

    def word(self) -> str:
        end = self.data.index(b"\0", self.at)
        word, self.at = self.data[self.at : end].decode("utf-8"), end + 1
        return word


def _cameras_bin(path: Path) -> dict[int, dict[str, Any]]:
    file = _Bytes(path)
    cameras = {}
    for _ in range(file.take("<Q")[0]):
        id, model, width, height = file.take("<iiQQ")
        name, parameters = MODELS.get(model, (f"number {model}", ()))
        cameras[id] = _camera(name, width, height, list(file.take(f"<{len(parameters)}d")), path)
    file.end()
    return cameras


def _images_bin(path: Path) -> list[View]:
    file = _Bytes(path)
    views = []
    for _ in range(file.take("<Q")[0]):
        id, *pose, camera = file.take("<i7di")
        name = file.word()
        file.skip(24 * file.take("<Q")[0])  # its features
        views.append(_view(id, pose[:4], pose[4:], camera, name, path))
    file.end()
    return views


def _points_bin(path: Path) -> np.ndarray:
    file = _Bytes(path)
    rows = []
    for _ in range(file.take("<Q")[0]):
        _, *row, _ = file.take("<Q3d3Bd")
        file.skip(8 * file.take("<Q")[0])  # where it was seen
        rows.append(row)
    file.end()
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


# Text.


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _cameras_txt(path: Path) -> dict[int, dict[str, Any]]:
    cameras = {}
    for line in filter(_is_data, _lines(path)):
        id, model, width, height, *parameters = line.split()
        cameras[int(id)] = _camera(model, int(width), int(height), [float(value) for value in parameters], path)
    return cameras


def _images_txt(path: Path) -> list[View]:
    views = []
    lines = iter(_lines(path))
    for line in lines:
        if not _is_data(line):
            continue
        id, *pose, camera, name = line.split(maxsplit=9)
        pose = [float(value) for value in pose]
        views.append(_view(int(id), pose[:4], pose[4:], int(camera), name.strip(), path))
        next(lines, None)  # its features
    return views


def _points_txt(path: Path) -> np.ndarray:
    rows = [[float(value) for value in line.split(maxsplit=7)[1:7]] for line in filter(_is_data, _lines(path))]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
