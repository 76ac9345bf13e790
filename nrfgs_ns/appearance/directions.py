# SPDX-License-Identifier: Apache-2.0
"""Unit vectors with a floor, for the heads that look from the camera to the splat, as spherical harmonics do.

The neural residual field looks the other way; its direction and distance are in `encoding.py`.
"""

from torch import Tensor


def unit_vectors(vectors: Tensor, floor: float) -> Tensor:
    """V / max(|v|, floor). Values and gradients are finite for any finite v; the gradient is at most 1 / floor.

    Args:
        vectors: [..., 3].
        floor: shortest length that is divided by, > 0, in the units of `vectors`.

    Returns:
        [..., 3], of length 1 wherever |v| >= floor, shorter elsewhere and 0 for v = 0.
    """
    return vectors / vectors.square().sum(dim=-1, keepdim=True).clamp_min(floor * floor).sqrt()
