# SPDX-License-Identifier: Apache-2.0
"""The point clouds that training starts from, read without open3d: .ply files and COLMAP's points3D.

Both readers return positions, float64 [N, 3] in the world of the file, and colours, uint8 [N, 3]. Points with a
non-finite position or colour are dropped, and a warning counts them. A file that cannot be read raises InputError:
points that are there but damaged must not turn into a random start unnoticed.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from nerfstudio.data.utils.colmap_parsing_utils import read_points3D_binary, read_points3D_text
from plyfile import PlyData, PlyParseError

from nrfgs_ns.data.checks import warn
from nrfgs_ns.errors import InputError

GREY = 127
"""Colour of points that have none."""


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads vertices (x, y, z) and their colours (red, green, blue: integers in [0, 255], or floats in
    [0, 1]) of a .ply file."""
    mend = "Repair or replace it, or remove ply_file_path from transforms.json to start from random points."
    if not path.is_file():
        raise InputError(f"{path}, named by ply_file_path, is missing. {mend}")
    try:
        vertices = PlyData.read(path)["vertex"].data
        xyz = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    except KeyError as error:
        raise InputError(f"{path} has no vertex element. {mend}") from error
    except (PlyParseError, OSError, ValueError, MemoryError) as error:
        raise InputError(f"{path} cannot be read as vertices with x, y, z ({error}). {mend}") from error
    if not {"red", "green", "blue"} <= set(vertices.dtype.names):
        warn(f"{path} has no colours; its points start in mid grey.")
        return _finite(xyz, np.full(xyz.shape, float(GREY)), path)
    rgb = np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=-1)
    return _finite(xyz, rgb.astype(np.float64) * (255.0 if rgb.dtype.kind == "f" else 1.0), path)


def read_colmap(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads points3D.bin or points3D.txt of a COLMAP model."""
    reader, path = read_points3D_binary, folder / "points3D.bin"
    if not path.is_file():
        reader, path = read_points3D_text, folder / "points3D.txt"
    if not path.is_file():
        raise InputError(f"{folder} holds neither points3D.bin nor points3D.txt. Restore one, or remove the folder.")
    try:
        points = reader(path).values()
    except (struct.error, OSError, ValueError, IndexError, MemoryError) as error:
        raise InputError(f"{path} cannot be read ({error}). Export the COLMAP model again.") from error
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([point.rgb for point in points], dtype=np.float64).reshape(-1, 3)
    return _finite(xyz, rgb, path)


def _finite(xyz: np.ndarray, rgb: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Drops what is not finite, with a warning, and rounds colours in [0, 255] to uint8."""
    good = np.isfinite(xyz).all(1) & np.isfinite(rgb).all(1)
    if not good.all():
        warn(f"{path}: {np.count_nonzero(~good)} of {len(good)} points have a NaN or infinite value and are left out.")
    xyz, rgb = xyz[good], rgb[good]
    if rgb.size and (rgb.min() < 0 or rgb.max() > 255):
        raise InputError(f"{path}: its colours are out of range. Store them as uchar, or as floats in [0, 1].")
    return xyz, np.rint(rgb).astype(np.uint8)
