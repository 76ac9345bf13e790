# SPDX-License-Identifier: Apache-2.0
"""Whether the training views see the initial points. Poses, intrinsics and points of different reconstructions, axes or
units each look sane by themselves."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras

from nrfgs_ns.data.cameras import undistorted_cameras
from nrfgs_ns.data.checks import some, warn
from nrfgs_ns.data.views import in_view
from nrfgs_ns.errors import InputError

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
    them; a warning names the views without any."""
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
