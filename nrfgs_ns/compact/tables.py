# SPDX-License-Identifier: Apache-2.0
"""The tables of a file: a splat's numbers before rounding, and the steps of the grids that they are rounded to.

means      [N, 3]
turns      [N, 3]   x, y, z of a rotation with w > 0: of the 24 that draw the same ellipsoid, with its axes named
                    otherwise, the smallest. A reader takes w = sqrt(max(1 - x^2 - y^2 - z^2, 1e-6)), and normalises
scales     [N, 3]   natural logarithms of the standard deviations, along the axes that the rotation names
opacities  [N, 1]   logits, cut off at +-10
colors     [N, 3]   base colours, 1 is white
latents    [N, R]
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nrfgs_ns.appearance.head import SH_C0, base_colors

Array = np.ndarray

COLUMNS = ("opacities", "scales", "colors", "turns")
"""Tables of all splats, besides the means, in the order of a file."""
SMALLEST_W2 = 1e-6
"""Smallest w^2 of a rotation: x, y and z may be rounded beyond unit length."""
STEPS = {
    "means": 1 / 32,
    "turns": 2**0.5 / 255,
    "scales": 1 / 16,
    "opacities": 1 / 16,
    "colors": 1 / 512,
    "latents": 1 / 16,
}
"""Steps of the grids without a fine-tune: means in standard deviations of the median splat, latents in those of the
strongest component. Means have the finest, because errors of place show first, and most with small splats. A sixteenth
is 6 % of a size, and at most 1/64 of an opacity."""
MOST_BITS = 21
"""Bits of a coordinate: three of them are interleaved in 63."""


class Grid(NamedTuple):
    """A uniform grid for each of C columns: value = low + step code, step > 0."""

    low: Array
    step: Array

    def codes(self, values: Array) -> Array:
        """Nearest grid points of values [N, C], int64, cut off at 2^62 steps."""
        return np.rint((values - self.low) / self.step).clip(-(2.0**62), 2.0**62).astype(np.int64)

    def values(self, codes: Array) -> Array:
        return self.low + self.step * codes


def morton(codes: Array) -> Array:
    """Morton numbers of coordinates [N, 3] of up to 21 bits, uint64 [N]: bit 3 k + a is bit k of axis a."""
    interleaved = np.zeros(len(codes), dtype=np.uint64)
    for axis, column in enumerate(codes.astype(np.uint64).T):
        for bit in range(MOST_BITS):
            interleaved |= ((column >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return interleaved


def from_morton(interleaved: Array) -> Array:
    """Coordinates [N, 3], int64, of Morton numbers [N]."""
    codes = np.zeros((3, len(interleaved)), dtype=np.uint64)
    for axis, column in enumerate(codes):
        for bit in range(MOST_BITS):
            column |= ((interleaved >> np.uint64(3 * bit + axis)) & np.uint64(1)) << np.uint64(bit)
    return codes.T.astype(np.int64, order="C")


GROUP = Rotation.create_group("O")
"""The 24 rotations that map the axes to the axes."""
OCTAHEDRAL = np.roll(GROUP.as_quat(), 1, axis=1)
"""The same as quaternions (w, x, y, z). [24, 4]"""
NEAR = 0.8
"""w of a rotation by 74 degrees. The smallest of the 24 turns by at most 62.8 degrees: w is at least 0.853."""


def nearest_turn(quats: Array, scales: Array) -> tuple[Array, Array]:
    """The same ellipsoids with their axes named so that rotations are smallest. One with |w| > NEAR keeps its axes.

    Takes quaternions (w, x, y, z) of any length except 0 [N, 4], and a scale for each axis [N, 3]; returns quaternions
    of unit length with w >= NEAR, and permuted scales.
    """
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    best = np.abs(unit @ (OCTAHEDRAL * [1, -1, -1, -1]).T).argmax(axis=1)  # |w| of q g
    best[np.abs(unit[:, 0]) > NEAR] = OCTAHEDRAL[:, 0].argmax()  # the identity
    turned = np.roll((Rotation.from_quat(np.roll(unit, -1, axis=1)) * GROUP[best]).as_quat(), 1, axis=1)
    turned *= np.where(turned[:, :1] < 0, -1.0, 1.0)
    axes = np.abs(GROUP.as_matrix()).argmax(axis=1)  # new axis j is old axis axes[j]
    return turned, np.take_along_axis(scales, axes[best], axis=1)


def tables_of(splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A file's tables of a field's splats, float64 without gradients."""
    double = {name: value.detach().double() for name, value in splats.items()}
    like = double["means"]
    quats, scales = nearest_turn(double["quats"].cpu().numpy(), double["scales"].cpu().numpy())
    return {
        "means": like,
        "turns": torch.from_numpy(quats[:, 1:]).to(like),
        "scales": torch.from_numpy(scales).to(like),
        "opacities": double["opacities"],
        "colors": base_colors(double["features_dc"]),
        "latents": double["latents"],
    }


def splats_of(tables: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A field's splats of a file's tables, with gradients."""
    turns = tables["turns"]
    w = (1.0 - turns.square().sum(dim=1, keepdim=True)).clamp_min(SMALLEST_W2).sqrt()
    return {
        "means": tables["means"],
        "quats": torch.nn.functional.normalize(torch.cat([w, turns], dim=1), dim=1),
        "scales": tables["scales"],
        "opacities": tables["opacities"],
        "features_dc": (tables["colors"] - 0.5) / SH_C0,
        "latents": tables["latents"],
    }


def steps_of(tables: Mapping[str, Tensor]) -> dict[str, Array]:
    """Steps of each table's columns without a fine-tune."""
    median = float(np.exp(np.median(tables["scales"].mean(dim=1).cpu().numpy())))
    spread = float(tables["latents"].std(dim=0, correction=0).max())
    units = {"means": median, "latents": spread if spread > 0 else 1.0 / STEPS["latents"]}
    return {name: np.full(tables[name].shape[1], step * units.get(name, 1.0)) for name, step in STEPS.items()}
