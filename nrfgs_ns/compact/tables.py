# SPDX-License-Identifier: Apache-2.0
"""The tables of a file: the numbers of a splat before they are rounded, and the steps to which they are.

means      [N, 3]
turns      [N, 3]   x, y, z of the rotation with w > 0 that turns least and draws the same ellipsoid: of the 24 ways to
                    name its axes. A reader takes w = sqrt(max(1 - x^2 - y^2 - z^2, 1e-6)), and unit length
scales     [N, 3]   natural logarithms of the standard deviations, along the axes that the rotation names
opacities  [N, 1]   logits, cut off at +-10
colors     [N, 3]   base colours, 1 is white
latents    [V, R]   of the V splats that are not diffuse
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nrfgs_ns.appearance.field import DIFFUSE
from nrfgs_ns.appearance.head import SH_C0, base_colors
from nrfgs_ns.compact.quantise import nearest_turn

COLUMNS = ("opacities", "scales", "colors", "turns")
"""Tables of all splats, beside the means, in the order of a file."""
SMALLEST_W2 = 1e-6
"""Smallest w^2 of a rotation: x, y and z may be rounded beyond unit length."""


@dataclass(frozen=True)
class Precision:
    """Steps of the grids. No number is off by more than half of its step."""

    means: float = 0.03125
    """largest step of a coordinate, in standard deviations of the median splat; 10 to 21 bits for each axis. Finer than
    the others, because a splat smaller than the median suffers more, and pixels notice places first"""
    quats: int = 8
    """bits of each of a rotation's three smaller components"""
    scales: float = 0.0625
    """step of a log scale: a sixteenth is 6 % of a size"""
    opacities: float = 0.0625
    """step of an opacity's logit: a sixteenth is at most 1/64 of opacity"""
    colors: float = 1 / 512
    """step of a base colour, in units of white"""
    latents: float = 0.0625
    """step of a latent's components, in standard deviations of the strongest"""


def tables_of(splats: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    """The file's tables of a field's table, float64 without gradients, and which splats are diffuse, bool [N]."""
    double = {name: value.detach().double() for name, value in splats.items() if name != DIFFUSE}
    like = double["means"]
    diffuse = splats.get(DIFFUSE, torch.zeros(len(like), dtype=torch.bool, device=like.device))
    quats, scales = nearest_turn(double["quats"].cpu().numpy(), double["scales"].cpu().numpy())
    return {
        "means": like,
        "turns": torch.from_numpy(quats[:, 1:]).to(like),
        "scales": torch.from_numpy(scales).to(like),
        "opacities": double["opacities"],
        "colors": base_colors(double["features_dc"]),
        "latents": double["latents"][~diffuse],
    }, diffuse


def splats_of(tables: Mapping[str, Tensor], diffuse: Tensor) -> dict[str, Tensor]:
    """The field's table of a file's, with gradients."""
    turns, latents = tables["turns"], tables["latents"]
    w = (1.0 - turns.square().sum(dim=1, keepdim=True)).clamp_min(SMALLEST_W2).sqrt()
    rows = (~diffuse).nonzero()[:, 0]
    return {
        "means": tables["means"],
        "quats": torch.nn.functional.normalize(torch.cat([w, turns], dim=1), dim=1),
        "scales": tables["scales"],
        "opacities": tables["opacities"],
        "features_dc": (tables["colors"] - 0.5) / SH_C0,
        "latents": latents.new_zeros(len(turns), latents.shape[1]).index_copy(0, rows, latents),
        DIFFUSE: diffuse,
    }


def steps_of(tables: Mapping[str, Tensor], precision: Precision) -> dict[str, np.ndarray]:
    """Steps of the grids, one for each column: `precision`, for tables that were not trained for the file."""
    median = float(np.exp(np.median(tables["scales"].mean(dim=1).cpu().numpy())))
    latents = tables["latents"]
    spread = float(latents.std(dim=0, correction=0).max()) if len(latents) > 1 else 0.0
    steps = {
        "means": precision.means * median,
        "turns": 2.0**0.5 / (2**precision.quats - 1),
        "scales": precision.scales,
        "opacities": precision.opacities,
        "colors": precision.colors,
        "latents": precision.latents * spread if spread > 0 else 1.0,
    }
    return {name: np.full(tables[name].shape[1], step) for name, step in steps.items()}
