# SPDX-License-Identifier: Apache-2.0
"""Some views of many: evenly spaced ones, those for testing; and the length that a capture is measured in."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

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
