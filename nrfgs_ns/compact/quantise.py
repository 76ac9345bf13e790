# SPDX-License-Identifier: Apache-2.0
"""Tables of splats as whole numbers, and back. float64 throughout; every function says how far it may be off."""

from typing import NamedTuple

import numpy as np

Array = np.ndarray

MOST_BITS = 21
"""For a coordinate: three of them are interleaved in 63 bits."""
HALF_SQRT2 = 0.5**0.5


class Grid(NamedTuple):
    """A uniform grid for each column: value = low + step code."""

    low: Array
    """[C]"""
    step: Array
    """[C], > 0"""

    def codes(self, values: Array) -> Array:
        """Nearest grid points of [N, C], int64. Off by at most step / 2, and float64's rounding."""
        return np.rint((values - self.low) / self.step).astype(np.int64)

    def values(self, codes: Array) -> Array:
        """[N, C]"""
        return self.low + self.step * codes

    def as_json(self) -> dict[str, list[float]]:
        return {"low": self.low.tolist(), "step": self.step.tolist()}


def grid_with_bits(values: Array, bits: int) -> Grid:
    """The grid of 2^bits points from the smallest to the largest number of each column of [N, C]."""
    if len(values) == 0:
        return Grid(np.zeros(values.shape[1]), np.ones(values.shape[1]))
    low, high = values.min(axis=0), values.max(axis=0)
    step = (high - low) / (2**bits - 1)
    return Grid(low, np.where(step > 0, step, 1.0))


def grid_with_step(values: Array, step: float) -> Grid:
    """The grid with a given step from the smallest number of each column of [N, C]."""
    low = values.min(axis=0) if len(values) else np.zeros(values.shape[1])
    return Grid(low, np.full(values.shape[1], step))


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


def smallest_three(quats: Array, bits: int) -> tuple[Array, Array]:
    """Rotations [N, 4] (w, x, y, z), of any length but 0: which component is largest, and codes of the other three.

    The quaternion is made of unit length, and its sign such that the largest component is positive; the others lie
    within sqrt(1/2) of 0 and go on a grid of 2^bits points over that range.

    Returns:
        largest [N], 0..3, and codes [N, 3] of the others in order, int64.
    """
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    rows = np.arange(len(unit))
    unit = unit * np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = unit[_others_of(largest)].reshape(-1, 3)
    return largest, np.rint((others + HALF_SQRT2) / (2 * HALF_SQRT2) * (2**bits - 1)).astype(np.int64)


def from_smallest_three(largest: Array, codes: Array, bits: int) -> Array:
    """Rotations of unit length [N, 4]. Each of the three is off by at most sqrt(1/2) / (2^bits - 1)."""
    others = codes / (2**bits - 1) * (2 * HALF_SQRT2) - HALF_SQRT2
    unit = np.empty((len(codes), 4))
    unit[_others_of(largest)] = others.reshape(-1)
    unit[np.arange(len(codes)), largest] = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=1), 0.0))
    return unit / np.linalg.norm(unit, axis=1, keepdims=True).clip(min=1e-12)


def _others_of(largest: Array) -> Array:
    """Mask [N, 4] of all components but one."""
    return np.arange(4) != largest[:, None]


def narrowest(codes: Array) -> Array:
    """The same whole numbers >= 0 in the narrowest of uint8, uint16, uint32 and uint64."""
    top = int(codes.max()) if codes.size else 0
    for dtype in (np.uint8, np.uint16, np.uint32):
        if top <= np.iinfo(dtype).max:
            return codes.astype(dtype)
    return codes.astype(np.uint64)
