# SPDX-License-Identifier: Apache-2.0
"""Directions and distances from splats to cameras, and the Fourier bands of directions.

For camera centre o and mean x: v = o - x, r = max(|v|, eps), d = v / r, distance feature log r. With the camera on the
splat |d| < 1, log r = log eps, and d's gradient is at most 1 / eps.
"""

import math

import torch
from torch import Tensor

NEAREST = 0.01
"""Smallest camera distance, in scene units: the near plane, closer than which nothing is drawn."""
FARTHEST = 1e18
"""Coordinates of v are clamped to this, without gradient beyond: their squares must stay below float32's 3e38."""
BAND_DIM = 6
"""Numbers in a band: sin and cos of three coordinates."""


def view_geometry(means: Tensor, camera_centers: Tensor, eps: float, unit: float = 1.0) -> tuple[Tensor, Tensor]:
    """Unit directions from splats to their cameras, and log distances.

    Args:
        means: [M, 3], world units.
        camera_centers: [3] or [M, 3], world units.
        eps: smallest distance, in scene units, > 0; shorter ones count as this.
        unit: world units in a scene unit.

    Returns:
        directions [M, 3], shorter than 1 where |v| < eps; logs of the distances in scene units, [M, 1], >= log eps.
    """
    v = (camera_centers - means).clamp(-FARTHEST, FARTHEST)
    r = v.square().sum(dim=-1, keepdim=True).clamp_min((eps * unit) ** 2).sqrt()
    return v / r, r.log() - math.log(unit)


def unit_vectors(vectors: Tensor, floor: float) -> Tensor:
    """Vectors v / max(|v|, floor), [..., 3], for finite v and floor > 0; its gradient is at most 1 / floor.

    Spherical harmonics and lobes take the direction from camera to splat, opposite to `view_geometry`'s.
    """
    return vectors / vectors.square().sum(dim=-1, keepdim=True).clamp_min(floor * floor).sqrt()


def fourier_bands(directions: Tensor, num_bands: int) -> tuple[Tensor, Tensor]:
    """Fourier bands of directions [M, 3], K >= 1: band k holds sin(2^k pi d) and cos(2^k pi d).

    Returns:
        low [M, 9], raw d and band 0; high [M, 6 (K - 1)], the others.
    """
    frequencies = math.pi * 2.0 ** torch.arange(num_bands, device=directions.device, dtype=directions.dtype)
    angles = directions[:, None, :] * frequencies[:, None]  # [M, K, 3]
    waves = torch.cat([angles.sin(), angles.cos()], dim=-1)  # [M, K, 6]
    return torch.cat([directions, waves[:, 0]], dim=-1), waves[:, 1:].flatten(1)
