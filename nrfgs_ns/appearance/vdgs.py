# SPDX-License-Identifier: Apache-2.0
"""VDGS: spherical harmonics whose opacity one network, shared by the scene, turns down with the view.

Seen from the direction d from camera to splat, splat i with mean x, opacity logit o and coefficients k has

    f       = sigmoid(network(d, grid(x))),
    opacity = sigmoid(o) f,       colour = max(0, 1/2 + sum_{l <= L} sum_m k_{l, m} Y_{l, m}(d)),

where grid is a hash grid of the mean in scene units (4 levels of 4 features, 524,288 shared numbers) and the network
has two hidden layers of 32 leaky ReLUs: 19 -> 32 -> 32 -> 1, 1,729 weights. f starts near 1/2. Source: the paper
"Gaussian Splatting with NeRF-based Color and Opacity", called VDGS, in the mode that multiplies opacity.

Grid and network have the reference's optimiser, Adam at 1e-3 without a schedule; all else is the host's, opacity resets
included, which the reference switches off. Pruning sees sigmoid(o), except in `mcmc` (the largest opacity shown).

The hash grid interpolates features of a position from lattices of growing resolution. Level l has N_l = floor(N_0 b^l)
lattice steps per unit of length and a table of T vectors of four features. At position x it interpolates trilinearly
between the eight lattice points around N_l x; lattice point (i, j, k) has row

    (i p_1) xor (j p_2) xor (k p_3)  mod T,    p = 1, 2654435761, 805459861

(T. Mueller, A. Evans, C. Schied, A. Keller, "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding",
SIGGRAPH 2022). Positions are coordinates in scene units, not normalised to a cube: the hash is defined on the whole
lattice, in two's complement, and nothing is clamped. T is a power of two, so that modulo T the hash is the one of
unsigned 32-bit arithmetic.

Where a level's lattice over [-1, 1]^3, to which nerfstudio scales its scenes, has no more points than the table has
rows, (2 N_l)^3 <= T, points are not hashed but numbered:

    (i mod 2 N_l) + 2 N_l (j mod 2 N_l) + (2 N_l)^2 (k mod 2 N_l).

Beyond the cube such a level repeats itself every 2 units; the hashed levels tell the repetitions apart. With N_0 = 16
and T = 2^15 level 0 is of this kind, and fills its table exactly.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.head import NEAR, Component, SplatAppearance, layers, unit_vectors
from nrfgs_ns.appearance.sh import ShConfig, SphericalHarmonics, eval_sh

HIDDEN_WIDTH = 32
"""Units of each hidden layer."""
PRIMES = (1, 2654435761, 805459861)
"""The hash's multipliers for x, y, z."""
FEATURES = 4
"""Numbers per lattice point and level."""
INITIAL_RANGE = 1e-4
"""Features start uniform in +- this, as in the paper."""


@dataclass
class VdgsConfig(ShConfig):
    """Spherical harmonics and a view-dependent factor. The defaults are the paper's."""

    _target: type = field(default_factory=lambda: ViewDirectionFactors)
    grid_base_resolution: int = 16
    """lattice steps per scene unit on the coarsest level."""

    def validate(self) -> None:
        super().validate()
        self.require(self.grid_base_resolution >= 1, "grid_base_resolution", "at least 1")


class ViewDirectionFactors(SphericalHarmonics):
    """Harmonics, and the base opacity multiplied by the network's factor."""

    name = "vdgs"
    is_harmonics = False

    def __init__(self, config: VdgsConfig):
        super().__init__(config)
        self.grid = HashGrid(config.grid_base_resolution)
        self.network = nn.Sequential(*layers(3 + self.grid.width, HIDDEN_WIDTH, HIDDEN_WIDTH, 1))

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        means, coefficients, opacities = self.rows(splats, visible, camera_centers)
        directions = unit_vectors(means - camera_centers, NEAR * self.scene_unit)
        factors = torch.sigmoid(self.network(torch.cat([directions, self.grid(means / self.scene_unit)], dim=-1)))
        colors = eval_sh(self.active_degree, directions, coefficients) + 0.5
        return SplatAppearance(colors.clamp_min(0.0), opacities * factors[:, 0])

    def components(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> dict[str, Component]:
        """The harmonics' "residual", and the factor's "opacity residual"."""
        seen = self(splats, visible, camera_centers)
        base = self.base_appearance(splats, visible)
        return {
            "residual": Component(seen.colors - base.colors, "color"),
            "opacity residual": Component((seen.opacities - base.opacities)[:, None], "opacity"),
        }


class HashGrid(nn.Module):
    """Features of positions, [M, 3] -> [M, levels * 4].

    Args:
        base_resolution: N_0, lattice steps per unit of length on level 0.
        levels: number of lattices, >= 1.
        log2_table_size: log2 T, rows of each level's table.
        per_level_scale: b, ratio of neighbouring levels' resolutions, >= 1.
    """

    def __init__(
        self, base_resolution: int, *, levels: int = 4, log2_table_size: int = 15, per_level_scale: float = 1.5
    ) -> None:
        super().__init__()
        self.table_size = 2**log2_table_size
        self.width = levels * FEATURES
        steps = [int(base_resolution * per_level_scale**level) for level in range(levels)]
        sides = [2 * n for n in steps if (2 * n) ** 3 <= self.table_size]  # of the numbered levels: the first ones
        self.table = nn.Parameter(torch.empty(levels * self.table_size, FEATURES).uniform_(-1.0, 1.0) * INITIAL_RANGE)
        self.register_buffer("resolutions", torch.tensor(steps, dtype=torch.float32), persistent=False)
        self.register_buffer("primes", torch.tensor(PRIMES), persistent=False)
        self.register_buffer("sides", torch.tensor(sides, dtype=torch.int64)[:, None, None], persistent=False)
        self.register_buffer("offsets", torch.arange(levels) * self.table_size, persistent=False)

    def forward(self, positions: Tensor) -> Tensor:
        """Interpolated features [M, levels * 4], level by level, of positions [M, 3] in scene units."""
        scaled = positions[:, None, :] * self.resolutions[:, None]  # [M, L, 3]
        cells = scaled.floor()
        after = scaled - cells
        weights = _corners(torch.stack([1.0 - after, after], dim=-1), torch.mul)  # [M, L, 8]
        cells = cells.long()
        rows = self._rows(torch.stack([cells, cells + 1], dim=-1))
        features = self.table.index_select(0, rows.flatten()).view(*weights.shape, FEATURES)  # [M, L, 8, F]
        return (weights[..., None] * features).sum(dim=2).flatten(1)

    def _rows(self, coordinates: Tensor) -> Tensor:
        """Rows of the table, [M, L, 8], for the lower and upper lattice coordinates, int64 [M, L, 3, 2]."""
        numbered = len(self.sides)
        stride = torch.cat([self.sides**0, self.sides, self.sides**2], dim=1)  # [numbered, 3, 1]
        in_cube = coordinates[:, :numbered].remainder(self.sides) * stride
        hashed = coordinates[:, numbered:] * self.primes[:, None]
        rows = [_corners(in_cube, torch.add), _corners(hashed, torch.bitwise_xor) & (self.table_size - 1)]
        return torch.cat(rows, dim=1) + self.offsets[:, None]


def _corners(per_axis: Tensor, combine: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Combine a cell's lower and upper values on three axes, [..., 3, 2], into its eight corners', [..., 8]."""
    x, y, z = per_axis.unbind(dim=-2)
    xy = combine(x[..., :, None], y[..., None, :])
    return combine(xy[..., :, :, None], z[..., None, None, :]).flatten(-3)
