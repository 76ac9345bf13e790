# SPDX-License-Identifier: Apache-2.0
"""COLMAP models, binary or text (https://colmap.github.io/format.html), as frames of a transforms.json, and points. A
damaged file raises InputError.

nerfstudio's readers are used for cameras and for points in text. Its readers of images cut names at blanks, and its
binary ones of images and points reserve gigabytes where a damaged file announces many features.
"""

import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils as nerfstudio_colmap
from nerfstudio.process_data.colmap_utils import parse_colmap_camera_params

from nrfgs_ns.data.checks import find_colmap
from nrfgs_ns.errors import InputError, refusing, shown

QUATERNION_TOLERANCE = 1e-2
"""Largest difference of a rotation quaternion's length from 1."""
EXPORT = "Export the COLMAP model again."


def read_frames(folder: Path) -> tuple[list[dict[str, Any]], Path]:
    """The photographs in the order of their ids, as frames of a transforms.json in COLMAP's world, and their file;
    InputError also where a camera model cannot be undistorted."""
    path = _file(folder, "cameras")
    read = nerfstudio_colmap.read_cameras_text if path.suffix == ".txt" else nerfstudio_colmap.read_cameras_binary
    cameras = {id: _lens(camera, path) for id, camera in _read(read, path).items()}
    path = path.with_stem("images")
    photographs = _read(_images_text, path) if path.suffix == ".txt" else _read(_entries, path, _image)
    if not photographs or any(frame["camera"] not in cameras for frame in photographs):
        raise InputError(f"{path} holds no photograph, or one whose camera is missing. {EXPORT}")
    return [frame | cameras[frame["camera"]] for frame in sorted(photographs, key=itemgetter("id"))], path


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray, Path]:
    """Positions and colours, float64 [N, 3] each, of points3D.bin or points3D.txt, and the file."""
    path = _file(folder, "points3D")
    if path.suffix == ".txt":
        rows = [(*point.xyz, *point.rgb) for point in _read(nerfstudio_colmap.read_points3D_text, path).values()]
    else:
        rows = _read(_entries, path, _point)
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:], path


def _file(folder: Path, stem: str) -> Path:
    """A file of a model: binary first, as in COLMAP."""
    for path in (folder / f"{stem}.bin", folder / f"{stem}.txt"):
        if path.is_file():
            return path
    if stem == "points3D":
        fix = "Copy it there, or start from random points with --load-3D-points False."
        raise InputError(f"{folder} holds neither {stem}.bin nor {stem}.txt. {fix}")
    root = next((parent for parent in folder.parents if parent.is_dir()), folder)
    place = find_colmap(root)
    where = f"There is a COLMAP model in {root / place}: give" if place else "Name the folder of the COLMAP model with"
    raise InputError(f"{folder} holds neither {stem}.bin nor {stem}.txt. {where} --colmap-path.")


def _read(read: Callable[..., Any], path: Path, *rest: Any) -> Any:
    with refusing(f"{path} cannot be read", EXPORT, Exception):  # whatever damaged bytes lead to
        return read(path, *rest)


def _lens(camera: Any, path: Path) -> dict[str, Any]:
    finding = f"{path}: a camera of model {shown(camera.model)} with {len(camera.params)} parameters is not supported"
    fix = "Undistort the photographs (colmap image_undistorter), or use OPENCV or OPENCV_FISHEYE."
    with refusing(finding, fix, NotImplementedError, IndexError, ValueError):
        return parse_colmap_camera_params(camera)


def _frame(id: int, pose: Sequence[float], camera: int, name: str) -> dict[str, Any]:
    """A frame (y up, z backwards) by COLMAP's pose (y down, z forwards): a unit quaternion and a position."""
    quaternion, position = np.split(np.array(pose, dtype=np.float64).reshape(7), [4])
    if not (abs(np.linalg.norm(quaternion) - 1) <= QUATERNION_TOLERANCE and np.isfinite(position).all()):
        raise ValueError(f"the pose of {name} holds NaN or Inf, or a quaternion that is not of length 1")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = nerfstudio_colmap.qvec2rotmat(quaternion)
    world_to_camera[:3, 3] = position
    camera_to_world = np.linalg.inv(world_to_camera) * (1.0, -1.0, -1.0, 1.0)
    return {"file_path": name, "id": id, "camera": camera, "transform_matrix": camera_to_world}


def _images_text(path: Path) -> list[dict[str, Any]]:
    frames = []
    lines = iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            id, *pose, camera, name = line.split(maxsplit=9)
            frames.append(_frame(int(id), pose, int(camera), name.strip()))
            features = next(lines, "").split()  # x, y and the point's number of each; the line may be empty
            if len(features) % 3 or not all(number.lstrip("-").isdigit() for number in features[2::3]):
                raise ValueError(f"the line after {name.strip()} is not of features: each image has two lines")
    return frames


def _entries(path: Path, read: Callable[[BinaryIO], Any]) -> list[Any]:
    """The entries of a binary file, which end where the file does."""
    with path.open("rb") as file:
        entries = [read(file) for _ in range(_take(file, "<Q")[0])]
        if file.tell() != path.stat().st_size:
            raise ValueError("the file is longer or shorter than its entries")
    return entries


def _image(file: BinaryIO) -> dict[str, Any]:
    id, *pose, camera = _take(file, "<i7di")
    name = b"".join(iter(lambda: _take(file, "c")[0], b"\0")).decode("utf-8")
    file.seek(24 * _take(file, "<Q")[0], 1)  # features
    return _frame(id, pose, camera, name)


def _point(file: BinaryIO) -> tuple:
    _, *position_and_color, _ = _take(file, "<Q3d3Bd")
    file.seek(8 * _take(file, "<Q")[0], 1)  # track
    return tuple(position_and_color)


def _take(file: BinaryIO, layout: str) -> tuple:
    return struct.unpack(layout, file.read(struct.calcsize(layout)))
