# SPDX-License-Identifier: Apache-2.0
"""Some views of many: evenly spaced ones, those for testing, those that differ; and a capture's unit of length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # `nrfgs prepare` does without torch
    from torch import Tensor


def evenly_spaced(total: int, wanted: int) -> list[int]:
    """At most `wanted` of 0..total-1, evenly spaced, the first among them."""
    count = min(total, wanted)
    return [i * total // count for i in range(count)]


def interior_test_images(count: int, every: int = 8) -> range:
    """Indices of the test images among `count` that are sorted by name: every eighth, beginning with index 4.

    Neither the first nor the last is taken: at the ends of a path there are training views on one side only, so that
    these images test extrapolation. (Of two images it is the first, of one that one.)
    """
    first = min(every // 2, (count - 1) // 2)
    return range(first, max(count - 1, first + 1), every)


SCALED = (2**-0.5, 2**0.5)
"""Largest coordinates between which cameras count as scaled to [-1, 1]: those of the training views among all."""


def scene_unit(positions: Tensor) -> float:
    """World units in one scene unit: the power of two nearest to the cameras' largest coordinate about their mean.

    Splatfacto's lengths (near plane, learning rate of the means, sizes at which splats split or go) and the field's
    distance are made for cameras within [-1, 1], where nerfstudio's auto-scaling puts them. They are scene units.

    1 if the cameras are within [-1, 1] and fill it, as nerfstudio leaves them, wherever their mean lies; 1 too if all
    stand at one place. A power of two, because scaling by it is exact.

    Args:
        positions: of the training cameras, [V, 3].
    """
    if len(positions) == 0 or SCALED[0] <= positions.abs().max().item() <= SCALED[1]:
        return 1.0
    positions = positions.double()
    reach = (positions - positions.mean(dim=0)).abs().max().item()
    return 2.0 ** round(math.log2(reach)) if reach > 0 else 1.0


SAME_PLACE = 0.01
"""Cameras nearer to each other than this share of the capture's reach stand at one place; in radians, they look one
way."""


def different_views(poses: Tensor) -> int:
    """V, the number of training views that a head is trusted by and steps are chosen by; duplicates count once.

    A copy of a photograph, or a frame of a video whose camera stands still, is where an earlier view is and looks where
    that one looks. From one place in another direction it is another view.

    Args:
        poses: camera-to-world, [V, 3 or 4, 4].
    """
    return len(_first_of_each(_places_and_directions(poses)))


def repeated_views(poses: Tensor, rows: Sequence[int], of: Sequence[int]) -> list[int]:
    """Those of some cameras that stand where one of others does, and look where that one looks.

    Args:
        poses: of the whole capture, camera-to-world, [V, 3 or 4, 4].
        rows, of: of `poses`.
    """
    from scipy.spatial import cKDTree

    if not (len(rows) and len(of)):
        return []
    places = _places_and_directions(poses)
    distances, _ = cKDTree(np.unique(places[list(of)], axis=0)).query(places[list(rows)])
    return [int(row) for row, distance in zip(rows, distances, strict=True) if distance <= SAME_PLACE]


def distinct_places(centers: Tensor) -> Tensor:
    """Cameras [V, 3] without those that stand where an earlier one does, [P, 3]."""
    return centers[_first_of_each(_in_reaches(centers))]


def _places_and_directions(poses: Tensor) -> np.ndarray:
    """Positions and viewing directions of cameras, float64 [V, 6], so that `SAME_PLACE` holds for both."""
    return np.concatenate([_in_reaches(poses[:, :3, 3]), poses[:, :3, 2].double().cpu().numpy()], axis=1)


def _in_reaches(centers: Tensor) -> np.ndarray:
    """Cameras [V, 3] about their mean, in distances from there to the farthest."""
    away = centers.double().cpu().numpy()
    away = away - away.mean(axis=0) if len(away) else away
    return away / np.linalg.norm(away, axis=1).max(initial=1e-300)


def _first_of_each(rows: np.ndarray) -> list[int]:
    """Rows [V, K] that are not near an earlier one of these.

    Near linear: rows that are kept lie apart, so that only a few of them find the same row in the tree.
    """
    from scipy.spatial import cKDTree

    kept, near = [], np.zeros(len(rows), dtype=bool)
    tree = cKDTree(rows) if len(rows) else None
    for i in range(len(rows)):
        if not near[i]:
            kept.append(i)
            near[tree.query_ball_point(rows[i], SAME_PLACE)] = True
    return kept
