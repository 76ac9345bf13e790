# SPDX-License-Identifier: Apache-2.0
"""Multiresolution hash grid: features of a position, interpolated from lattices of growing resolution.

Level l has N_l = floor(N_0 b^l) lattice steps per unit of length and a table of T vectors of four features. At position
x it interpolates trilinearly between the eight lattice points around N_l x; lattice point (i, j, k) has row

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

On CUDA, two Triton kernels compute all this in float32 and its gradients (`hash_grid_triton.py`), once differentiable.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from nrfgs_ns.kernels.trial import tried_once

PRIMES = (1, 2654435761, 805459861)
"""The hash's multipliers for x, y, z; `hash_grid_triton.py` repeats them."""
FEATURES = 4
"""Numbers per lattice point and level."""
INITIAL_RANGE = 1e-4
"""Features start uniform in +- this, as in the paper."""


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
        float32 = positions.dtype == self.table.dtype == torch.float32
        if positions.is_cuda and float32 and kernels_run_on(positions.device):
            from nrfgs_ns.appearance.hash_grid_triton import Interpolation

            return Interpolation.apply(positions, self.table, self.resolutions, len(self.sides), self.table_size)
        return self.in_torch(positions)

    def in_torch(self, positions: Tensor) -> Tensor:
        """The kernels' twin: the same in PyTorch, on any device and of any floating dtype."""
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


@tried_once("The hash grid")
def kernels_run_on(device: torch.device) -> None:
    """Whether Triton's kernels run on a CUDA device."""
    from nrfgs_ns.appearance.hash_grid_triton import Interpolation

    position, table = (torch.zeros(*shape, device=device, requires_grad=True) for shape in ((1, 3), (2, FEATURES)))
    Interpolation.apply(position, table, torch.ones(1, device=device), 0, 2).sum().backward()
