# SPDX-License-Identifier: Apache-2.0
"""Tables of splats as whole numbers, and back, in float64."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray

MOST_BITS = 21
"""For a coordinate: three of them are interleaved in 63 bits."""


class Grid(NamedTuple):
    """A uniform grid for each column: value = low + step code."""

    low: Array
    """[C]"""
    step: Array
    """[C], > 0"""

    def codes(self, values: Array) -> Array:
        """Nearest grid points of [N, C], int64, of those within 2^62 steps. Off by at most step / 2, and float64's
        rounding."""
        return np.rint((values - self.low) / self.step).clip(-(2.0**62), 2.0**62).astype(np.int64)

    def values(self, codes: Array) -> Array:
        """[N, C]"""
        return self.low + self.step * codes


def morton(codes: Array) -> Array:
    """Interleaved bits of three coordinates [N, 3] of up to 21 bits, uint64 [N]: bit 3 k + a is bit k of axis a."""
    spread = np.zeros(len(codes), dtype=np.uint64)
    for axis in range(3):
        x = codes[:, axis].astype(np.uint64)
        for shift, mask in _SPREADS:
            x = (x | (x << np.uint64(shift))) & np.uint64(mask)
        spread |= x << np.uint64(axis)
    return spread


def from_morton(interleaved: Array) -> Array:
    """The coordinates [N, 3], int64, of `morton`'s numbers [N]."""
    columns = []
    for axis in range(3):
        x = (interleaved >> np.uint64(axis)) & np.uint64(_SPREADS[-1][1])
        for (shift, _), (_, mask) in zip(_SPREADS[::-1], [*_SPREADS[-2::-1], (0, 0x1FFFFF)], strict=True):
            x = (x | (x >> np.uint64(shift))) & np.uint64(mask)
        columns.append(x.astype(np.int64))
    return np.stack(columns, axis=1)


_SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that pull 21 bits apart, two zeros between neighbours."""


GROUP = Rotation.create_group("O")
"""The 24 rotations that take the axes to the axes."""
OCTAHEDRAL = np.roll(GROUP.as_quat(), 1, axis=1)
"""The same as quaternions (w, x, y, z). [24, 4]"""
NEAR = 0.8
"""A rotation by 74 degrees; the nearest of 24 turns by no more than 62.8, where w is 0.853."""


def nearest_turn(quats: Array, scales: Array) -> tuple[Array, Array]:
    """The same ellipsoids by the rotations that turn least: of the 24 ways to name an ellipsoid's axes, the one whose
    rotation is nearest to the identity. A rotation with |w| > NEAR is left as it is.

    Args:
        quats: rotations (w, x, y, z) of any length but 0. [N, 4]
        scales: one for each axis. [N, 3]

    Returns:
        quats [N, 4] of unit length with w >= NEAR, and scales [N, 3], permuted.
    """
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    best = np.abs(unit @ (OCTAHEDRAL * [1, -1, -1, -1]).T).argmax(axis=1)  # |w| of q g
    best[np.abs(unit[:, 0]) > NEAR] = OCTAHEDRAL[:, 0].argmax()  # the identity
    turned = np.roll((Rotation.from_quat(np.roll(unit, -1, axis=1)) * GROUP[best]).as_quat(), 1, axis=1)
    turned *= np.where(turned[:, :1] < 0, -1.0, 1.0)
    axes = np.abs(GROUP.as_matrix()).argmax(axis=1)  # new axis j is old axis axes[j]
    return turned, np.take_along_axis(scales, axes[best], axis=1)
