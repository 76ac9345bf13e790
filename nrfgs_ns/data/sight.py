# SPDX-License-Identifier: Apache-2.0
"""Do the cameras see the points that training starts from?

Poses, intrinsics and points may each look sane and not belong together: another unit, another axis, another
reconstruction. Then nothing is drawn, or next to nothing, and training cannot know. So before the first step the points
are projected into the training views.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from nrfgs_ns.data.checks import some, warn
from nrfgs_ns.errors import InputError

FARTHEST = 1e5
"""Points this many times as far from the cameras' middle as the farthest camera are no part of the scene."""
MOST_POINTS = 10_000
"""Points that are looked for, evenly spread over the list: the share of the others is the same."""
MARGIN = 0.25
"""Of an image's size, by which lens distortion may move a point."""
FEWEST_SEEN = 0.01
"""Share of the points that must be in some view."""
MOST_BLIND = 0.5
"""Share of the views that may see no point."""
LEAST_SPREAD = 0.01
"""Points whose distance from their middle is a smaller share of the cameras' distance from there are one spot to them;
medians. Of real captures it is 0.1 and more."""
ONE_WORLD = "Poses, intrinsics and points must be of one reconstruction, in one world and unit."


def in_reach(xyz: np.ndarray, cameras: Cameras, source: Path) -> np.ndarray:
    """Which points [N, 3] are near enough to belong to the scene, bool [N]; a warning counts the others.

    Raises:
        InputError: fewer than half are.
    """
    positions = cameras.camera_to_worlds[:, :3, 3].double().numpy()
    middle = positions.mean(axis=0)
    distance = np.abs(xyz - middle).max(axis=1, initial=0)
    reach = np.abs(positions - middle).max() or np.median(distance)  # of cameras at one place, the points' own
    near = distance <= FARTHEST * reach
    lost = np.count_nonzero(~near)
    if lost > len(xyz) / 2:
        raise InputError(
            f"{source}: {lost} of {len(xyz)} points are {FARTHEST:,.0f} times as far away as the farthest camera. "
            f"{ONE_WORLD}"
        )
    if lost:
        warn(
            f"{source}: {lost} of {len(xyz)} points are {FARTHEST:,.0f} times as far away as the farthest camera and "
            "are left out."
        )
    return near


def check_sight(xyz: torch.Tensor, cameras: Cameras, names: Sequence[str], source: Path) -> None:
    """Enough points are in some training view, at more than one place, and most views have some; the views without any
    are named.

    Args:
        xyz: points in the world of the cameras, [N, 3].
        cameras: of the training views, [V].
    """
    points = xyz[:: max(len(xyz) // MOST_POINTS, 1)].float()
    seen = torch.zeros(len(points), dtype=torch.bool)
    blind = []
    for index, name in enumerate(names):
        visible = _in_view(points, cameras[index])
        seen |= visible
        if not visible.any():
            blind.append(name)
    share = seen.float().mean().item()
    if share < FEWEST_SEEN:
        raise InputError(
            f"{source}: of the {len(xyz)} points to start from, {100 * share:.2g} % are in any of the {len(names)} "
            f"training views. {ONE_WORLD}"
        )
    middle = points.median(dim=0).values
    spread, away = ((places - middle).norm(dim=1).median() for places in (points, cameras.camera_to_worlds[:, :3, 3]))
    if spread <= LEAST_SPREAD * away:
        raise InputError(
            f"{source}: the {len(xyz)} points to start from are all at one place, or half of them are. Make the points "
            "anew, or start from random ones with --load-3D-points False."
        )
    if len(blind) > MOST_BLIND * len(names):
        raise InputError(
            f"{source}: {len(blind)} of {len(names)} training views see none of the {len(xyz)} points to start from: "
            f"{some(blind)}. {ONE_WORLD}"
        )
    if blind:
        warn(
            f"{source}: {len(blind)} of {len(names)} training views see none of the {len(xyz)} points to start from: "
            f"{some(blind)}. If their poses are wrong, correct them or remove the frames."
        )


def _in_view(points: torch.Tensor, camera: Cameras) -> torch.Tensor:
    """Which points [N, 3] are in front of a camera and in its image or a margin about it, bool [N]."""
    rotation, position = camera.camera_to_worlds[:3, :3], camera.camera_to_worlds[:3, 3]
    x, y, z = ((points - position) @ rotation).unbind(-1)
    depth = -z
    if camera.camera_type.item() == CameraType.FISHEYE.value:  # distances in the image are angles
        off_axis = torch.hypot(x, y)
        x, y = (value / off_axis.clamp(min=1e-12) * torch.atan2(off_axis, depth) for value in (x, y))
    else:
        x, y = x / depth, y / depth
    u, v = camera.fx * x + camera.cx, camera.cy - camera.fy * y
    width, height = camera.width, camera.height
    inside = (u > -MARGIN * width) & (u < (1 + MARGIN) * width) & (v > -MARGIN * height) & (v < (1 + MARGIN) * height)
    return inside & (depth > 0)
