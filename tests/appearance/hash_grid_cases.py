# SPDX-License-Identifier: Apache-2.0
"""The hash grid's kernels beside PyTorch's grid in float64: cases, and the judge. Shared by CPU and GPU tests."""

import copy

import torch
from fused_cases import ULP
from torch import Tensor

from nrfgs_ns.appearance.hash_grid import FEATURES, HashGrid


def grids(device: str = "cpu", **options) -> tuple[HashGrid, HashGrid]:
    """A grid in float32, and the same in float64. By default 4, 6 and 9 lattice steps per unit in tables of 2,048
    rows: two numbered levels, the sides of one of which, 12, are no power of two, and a hashed one."""
    torch.manual_seed(0)
    defaults = {"levels": 3, "log2_table_size": 11, "base_resolution": 4, "per_level_scale": 1.5}
    grid = HashGrid(**{**defaults, **options})
    grid.table.data.normal_()
    grid = grid.to(device)
    return grid, copy.deepcopy(grid).double()


def positions(count: int, device: str = "cpu", seed: int = 1) -> Tensor:
    """Positions near and far, some of them on lattice points, at all signs, float32 [count, 3].

    In turn within 2 units, within 2^14, and within 2^25. All times up to 54 steps per unit float32 holds exactly, so
    that float64 finds the same cells and the same distances into them: 13, 18 and 6 bits, and 6 bits.
    """
    generator = torch.Generator().manual_seed(seed)
    steps = torch.tensor([2.0**-11, 2.0**-3, 2.0**20])[torch.arange(count) % 3]
    ends = torch.tensor([2.0**12, 2.0**17, 2.0**5])[torch.arange(count) % 3]
    whole = ((2 * torch.rand(count, 3, generator=generator) - 1) * ends[:, None]).round()
    return (whole * steps[:, None]).to(device)


def assert_near_twin(grid: HashGrid, twin: HashGrid, x: Tensor, interpolate) -> None:
    """Features of `interpolate(grid, x)` and both gradients are the twin's, as far as float32's roundings explain.

    Distances into a cell, and 1 minus them, are exact (`positions`). Each number is a sum of products, and off by the
    number of roundings that a product goes through times the sum of the products' sizes:

    feature: 2 in the weight, 1 times the feature, 7 additions of eight corners.
    table: 2 in the weight, 1 times the gradient, and an addition for each further corner that uses the row.
    position: 1 feature times gradient, F - 1 additions; 1 in the weight of a face's corner, 1 times it, 7 additions of
        eight; 1 times the resolution, L - 1 additions of levels. The weights of the four edges along an axis add up to
        1, and each has two ends: products add up to at most twice the largest feature times the gradient.
    """
    x, exact_x = x.detach().requires_grad_(), x.detach().double().requires_grad_()
    levels, features = len(twin.resolutions), FEATURES
    found, exact = interpolate(grid, x), twin.in_torch(exact_x)
    assert found.shape == exact.shape and found.dtype == torch.float32
    upstream = torch.randn(exact.shape, generator=torch.Generator().manual_seed(7)).to(x.device)
    d_x, d_table = torch.autograd.grad(found, (x, grid.table), upstream)
    exact_d_x, exact_d_table = torch.autograd.grad(exact, (exact_x, twin.table), upstream.double())

    sizes = copy.deepcopy(twin)
    sizes.table.data.abs_()
    assert_within(found, exact, 10 * sizes.in_torch(exact_x.detach()))

    (size_d_table,) = torch.autograd.grad(twin.in_torch(exact_x), twin.table, upstream.abs().double())
    cells = (exact_x.detach()[:, None] * twin.resolutions[:, None]).floor().long()
    uses = twin._rows(torch.stack([cells, cells + 1], dim=-1)).flatten().bincount(minlength=len(twin.table))
    assert_within(d_table, exact_d_table, (uses[:, None] + 2) * size_d_table)

    largest = sizes.table.detach().view(levels, -1, features).amax(dim=1) * twin.resolutions[:, None]
    size_d_x = 2 * (upstream.double().abs() * largest.flatten()).sum(dim=1, keepdim=True)
    assert_within(d_x, exact_d_x, (features + levels + 9) * size_d_x)


def assert_within(found: Tensor, exact: Tensor, roundings: Tensor) -> None:
    """Each number is off by at most so many roundings; 1% more because they multiply instead of adding up."""
    assert torch.isfinite(found).all()
    excess = ((found.double() - exact).abs() - 1.01 * ULP * roundings).amax() if exact.numel() else torch.zeros(())
    assert excess <= 0, f"{excess.item():.3g} beyond what float32 explains"
