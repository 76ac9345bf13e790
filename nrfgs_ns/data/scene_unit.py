# SPDX-License-Identifier: Apache-2.0
"""The length that a capture is measured in.

Splatfacto's lengths (near plane, learning rate of the means, sizes at which splats split or go), and the field's (the
distance that it sees), are made for cameras within [-1, 1], where nerfstudio's auto-scaling puts them. Without it, a
scene in millimetres lies a thousand times too far away, and one in kilometres before the near plane. So every one of
these lengths is taken in scene units.
"""

import math

from torch import Tensor

SCALED = (2**-0.5, 2**0.5)
"""Largest coordinates between which cameras count as scaled to [-1, 1]: those of the training views among all."""


def scene_unit(positions: Tensor) -> float:
    """World units in one scene unit: the power of two nearest to the cameras' largest coordinate about their mean.

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
