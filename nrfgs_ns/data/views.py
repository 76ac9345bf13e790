# SPDX-License-Identifier: Apache-2.0
"""Choices of views: evenly spaced, for testing, different ones; a capture's unit of length, and how near it comes."""

import math

import numpy as np
from nerfstudio.cameras.cameras import Cameras
from scipy.spatial import cKDTree
from torch import Tensor, cdist


def evenly_spaced(total: int, wanted: int) -> list[int]:
    """At most `wanted` of 0..total-1, evenly spaced from 0."""
    count = min(total, wanted)
    return [i * total // count for i in range(count)]


def interior_test_images(count: int, every: int = 8) -> range:
    """Indices of the test images among `count` sorted by name: every eighth from index 4, without the ends of a path,
    which would test extrapolation. Of one or two images it is the first."""
    first = min(every // 2, (count - 1) // 2)
    return range(first, max(count - 1, first + 1), every)


SCALED = (2**-0.5, 2**0.5)
"""Largest coordinates between which cameras count as scaled to [-1, 1]."""


def scene_unit(positions: Tensor) -> float:
    """World units in one scene unit, for training cameras at `positions` [V, 3].

    Splatfacto's lengths (near plane, learning rate of the means, sizes at which splats split or go) and the field's
    distance assume cameras that fill [-1, 1], as after nerfstudio's auto-scaling: there, and for cameras at one place,
    it is 1. Otherwise it is the power of two (an exact scale) nearest to the cameras' largest coordinate about their
    mean.
    """
    if len(positions) == 0 or SCALED[0] <= positions.abs().max().item() <= SCALED[1]:
        return 1.0
    positions = positions.double()
    reach = (positions - positions.mean(dim=0)).abs().max().item()
    return 2.0 ** round(math.log2(reach)) if reach > 0 else 1.0


SAME_PLACE = 0.01
"""Largest difference of cameras at one place, relative to the largest distance of a camera from the mean of all; and of
one direction, in radians."""


def different_views(poses: Tensor) -> int:
    """Number of different views among camera-to-world poses [V, 3 or 4, 4]: without those at the place and in the
    direction of an earlier one, such as copies, or frames of a camera that stands still."""
    directions = poses[:, :3, 2].double().cpu().numpy()
    return len(_first_of_each(np.concatenate([_in_reaches(poses[:, :3, 3]), directions], axis=1)))


NEAREST_SHARE = 0.01
"""Share of the points in an image that may be nearer than what counts as its nearest."""
FEWEST_POINTS = 20
"""Points in an image below which it says nothing about what is near."""


def nearest_depth(points: Tensor, cameras: Cameras) -> float:
    """Depth at which the nearest training camera sees the nearest points, in world units; 0 if no camera sees enough.

    Args:
        points: the capture's points, [P, 3], world units.
        cameras: the training's pinhole cameras, [V].
    """
    points = points[:: max(len(points) // 10_000, 1)].float()
    nearest = math.inf
    for camera in cameras:
        seen, depths = in_view(points, camera)
        depths = depths[seen]
        if len(depths) > FEWEST_POINTS:
            nearest = min(nearest, depths.quantile(NEAREST_SHARE).item())
    return nearest if nearest < math.inf else 0.0


def in_view(points: Tensor, camera: Cameras, share: float = 1.0) -> tuple[Tensor, Tensor]:
    """Whether points [N, 3] are in the image of a pinhole camera, bool [N], and their depths, [N].

    Args:
        camera: one, [] or a batch of one, [1].
        share: of the image's width and height that counts, about its middle; it may be larger than 1.
    """
    camera = camera.reshape(()).to(points.device)
    x, y, z = ((points - camera.camera_to_worlds[:, 3]) @ camera.camera_to_worlds[:, :3]).unbind(-1)
    u, v = (camera.fx * x / -z + camera.cx) / camera.width, (camera.cy - camera.fy * y / -z) / camera.height
    return (z < 0) & ((u - 0.5).abs() <= share / 2) & ((v - 0.5).abs() <= share / 2), -z


def distinct_places(centers: Tensor) -> Tensor:
    """Camera centres [V, 3] without those at the place of an earlier one, [P, 3]."""
    return centers[_first_of_each(_in_reaches(centers))]


NEIGHBOURS = 2
"""Nearest places to which distances are measured."""


def camera_spacing(centers: Tensor) -> float:
    """The distance between neighbouring training cameras with these centres [V, 3]; 0 if all stand at one place.

    It is the median, weighted by length, of the distances from each place to the two nearest other places. The short
    distances in pairs and clusters of cameras do not decide it, nor do the long ones of a few cameras far off.
    """
    places = distinct_places(centers.double())
    count = min(NEIGHBOURS, len(places) - 1)
    if count == 0:
        return 0.0
    distances = cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = distances.fill_diagonal_(math.inf).topk(count, largest=False).values.flatten().sort().values
    covered = nearest.cumsum(0)
    return nearest[int((covered < 0.5 * covered[-1]).sum())].item()


def _in_reaches(centers: Tensor) -> np.ndarray:
    """Camera centres [V, 3] relative to their mean, in units of the largest distance from it."""
    centers = centers.double().cpu().numpy()
    offsets = centers - centers.mean(axis=0)
    return offsets / np.linalg.norm(offsets, axis=1).max(initial=1e-300)


def _first_of_each(rows: np.ndarray) -> list[int]:
    """Indices of rows [V, K] not within `SAME_PLACE` of an earlier one, in almost linear time."""
    kept = []
    near = np.zeros(len(rows), dtype=bool)
    tree = cKDTree(rows)
    for i in range(len(rows)):
        if not near[i]:
            kept.append(i)
            near[tree.query_ball_point(rows[i], SAME_PLACE)] = True
    return kept
