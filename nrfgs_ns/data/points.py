# SPDX-License-Identifier: Apache-2.0
"""Initial point clouds: .ply files, without open3d; which points are good, and whether the training views see them.

Positions are float64 [N, 3] in the world of the file, colours uint8 [N, 3]. Points that are not finite are left out
with a warning. A damaged file raises InputError: no training starts from random points unnoticed.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from plyfile import PlyData

from nrfgs_ns.data.checks import some, warn
from nrfgs_ns.data.lenses import undistorted_cameras
from nrfgs_ns.data.views import in_view
from nrfgs_ns.errors import InputError, refusing, shown

GREY = 127
"""Colour of points that have none."""
LONGEST_HEADER = 2**16
"""Bytes in which the header of a .ply must end."""
FARTHEST = 1e5
"""Points this many times as far from the cameras' middle as the farthest camera are left out."""
MOST_POINTS = 10_000
"""Points that are projected, evenly spread over the list."""
FEWEST_SEEN = 0.01
"""Share of the points that must be in some view."""
MOST_BLIND = 0.5
"""Share of the views that may see no point."""
LEAST_SPREAD = 0.01
"""Smallest median distance of points from their middle, relative to the cameras'; in real captures at least 0.1."""
ONE_WORLD = "Poses, intrinsics and points must be of one reconstruction, in one world and unit."


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (x, y, z) and their colours (red, green, blue: integers in [0, 255], or floats in [0, 1])."""
    fix = "Repair or replace it, or remove ply_file_path from transforms.json to start from random points."
    if not os.path.isfile(path):  # False, too, for a name that cannot be
        raise InputError(f"{shown(str(path))}, named by ply_file_path, is missing. {fix}")
    # plyfile lets out whatever it meets in a broken file
    with refusing(f"{path} cannot be read as vertices with x, y, z", fix, Exception):
        with path.open("rb") as file:
            if b"end_header" not in file.read(LONGEST_HEADER):
                raise ValueError(f"no end_header in its first {LONGEST_HEADER} bytes")
        vertices = PlyData.read(path)["vertex"].data
        stored = _columns(vertices, "xyz")
        has_colors = {"red", "green", "blue"} <= set(vertices.dtype.names)
        rgb = _columns(vertices, ("red", "green", "blue")) if has_colors else np.full(stored.shape, GREY)
    if not has_colors:
        warn(f"{path} has no colours; its points start in mid grey.")
    rgb = rgb.astype(np.float64) * (255.0 if rgb.dtype.kind == "f" else 1.0)
    return finite(stored.astype(np.float64), rgb, path)


def _columns(vertices: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Properties of vertices, [N, 3]."""
    table = np.stack([vertices[name] for name in names], axis=-1)
    if table.dtype.kind not in "iuf":  # lists: NumPy before 2.2 takes lists of one for numbers
        raise ValueError(f"{', '.join(names)} are not numbers")
    return table


def finite(xyz: np.ndarray, rgb: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The finite points of a file, with colours as uint8."""
    good = np.isfinite(xyz).all(1) & np.isfinite(rgb).all(1)
    finding = f"{path}: {np.count_nonzero(~good)} of {len(good)} points have a NaN or infinite value"
    if np.count_nonzero(good) < len(good) / 2:
        raise InputError(f"{finding}. Repair or replace the file.")
    if not good.all():
        warn(f"{finding} and are left out.")
    xyz, rgb = xyz[good], rgb[good]
    if rgb.size and (rgb.min() < 0 or rgb.max() > 255):
        raise InputError(f"{path}: its colours are out of range. Store them as uchar, or as floats in [0, 1].")
    return xyz, np.rint(rgb).astype(np.uint8)


def in_reach(xyz: np.ndarray, cameras: Cameras, source: Path) -> np.ndarray:
    """Points [N, 3] near enough to belong to the scene, bool [N]; a warning counts the others."""
    positions = cameras.camera_to_worlds[:, :3, 3].double().numpy()
    middle = positions.mean(axis=0)
    distance = np.abs(xyz - middle).max(axis=1, initial=0)
    reach = np.abs(positions - middle).max() or np.median(distance)  # the points' own if all cameras are at one place
    near = distance <= FARTHEST * reach
    if not near.all():
        finding = f"{np.count_nonzero(~near)} of {len(xyz)} points are {FARTHEST:,.0f} times as far away"
        warn(f"{source}: {finding} as the farthest camera and are left out.")
    return near


def check_sight(xyz: torch.Tensor, cameras: Cameras, names: Sequence[str], source: Path) -> None:
    """Check that the named training views see enough of the points [N, 3], at different places, and most views some of
    them; a warning names the views without any. Poses and points of different worlds each look sane."""
    points = xyz[:: max(len(xyz) // MOST_POINTS, 1)].float()
    visible = [in_view(points, camera)[0] for camera in undistorted_cameras(cameras)]
    blind = [name for name, seen in zip(names, visible, strict=True) if not seen.any()]
    share = torch.stack(visible).any(dim=0).float().mean().item()
    if not share >= FEWEST_SEEN:  # nor without points
        raise InputError(f"{source}: {100 * share:.2g} % of the {len(xyz)} points are in a training view. {ONE_WORLD}")
    middle = points.median(dim=0).values
    spread = (points - middle).norm(dim=1).median()
    cameras_away = (cameras.camera_to_worlds[:, :3, 3] - middle).norm(dim=1).median()
    if spread <= LEAST_SPREAD * cameras_away:
        fix = "Make the points anew, or start from random ones with --load-3D-points False."
        finding = f"the {len(xyz)} points to start from are all at one place, or half of them are"
        raise InputError(f"{source}: {finding}. {fix}")
    finding = f"{source}: {len(blind)} of {len(names)} training views see none of the {len(xyz)} points to start from"
    if len(blind) > MOST_BLIND * len(names):
        raise InputError(f"{finding}: {some(blind)}. {ONE_WORLD}")
    if blind:
        warn(f"{finding}: {some(blind)}. If their poses are wrong, correct them or remove the frames.")
