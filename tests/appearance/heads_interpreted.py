# SPDX-License-Identifier: Apache-2.0
"""The kernels of harmonics and of the hash grid in Triton's interpreter against their twins."""

import pytest
import quick_interpreter  # noqa: F401
import torch
from hash_grid_cases import assert_near_twin, grids, positions
from torch.testing import assert_close

from nrfgs_ns.appearance import hash_grid_triton
from nrfgs_ns.appearance.harmonics_triton import Harmonics
from nrfgs_ns.appearance.hash_grid_triton import Interpolation
from nrfgs_ns.appearance.sh import eval_sh, num_bases


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(hash_grid_triton, "BLOCK", 64)


def interpolate(grid, x):
    return Interpolation.apply(x, grid.table, grid.resolutions, len(grid.sides), grid.table_size)


@pytest.mark.parametrize("count, options, numbered", [
    (0, {"levels": 1}, 1),
    (65, {"levels": 1}, 1),  # one more than a block
    (60, {}, 2),
    (30, {"levels": 2, "log2_table_size": 1}, 0),
    (30, {"levels": 4, "log2_table_size": 15, "base_resolution": 16}, 1),  # the paper's: 16, 24, 36, 54
])  # fmt: skip
def test_hash_grid_values_and_gradients(count, options, numbered):
    grid, twin = grids(**options)
    assert len(grid.sides) == numbered
    assert_near_twin(grid, twin, positions(count), interpolate)


def test_tensors_that_are_not_contiguous():
    grid, twin = grids(levels=1)
    x = positions(3 * 20).view(20, 9)[:, ::3].detach().requires_grad_()
    assert not x.is_contiguous()
    assert_near_twin(grid, twin, x, interpolate)
    interpolate(grid, x).sum().backward()  # its gradient is one number, expanded
    assert torch.isfinite(x.grad).all() and (x.grad != 0).all()


@pytest.mark.filterwarnings("ignore:invalid value")  # numpy's; it is the case's
def test_what_is_no_lattice_coordinate():
    """Beyond 2^31 steps features are those of one lattice point; a position that is NaN or infinite gets NaN."""
    grid, _ = grids()
    wild = [[3e8] * 3, [1e12] * 3, [1e30] * 3, [0.1, torch.nan, 0.1], [0.1, 0.1, torch.inf], [0.3, -0.2, 0.1]]
    x = torch.tensor(wild, requires_grad=True)
    features = interpolate(grid, x)
    features.sum().backward()
    last = 2**31 - 2**7  # float32's last before 2^31; times 9 steps all three positions are beyond
    row = (last ^ last * 2654435761 ^ last * 805459861) % grid.table_size
    assert (features[:3, -4:] == grid.table[2 * grid.table_size + row]).all()
    assert features[3:5].isnan().all()
    assert torch.isfinite(features[[0, 1, 2, 5]]).all() and torch.isfinite(x.grad[[0, 1, 2, 5]]).all()


# Harmonics.
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize(("splats", "highest"), [(0, 3), (1, 3), (200, 3), (130, None)])
def test_colours_and_gradients_are_those_of_the_twin(degree, splats, highest):
    """On a CPU `eval_sh` is the twin."""
    torch.manual_seed(degree)
    bases = num_bases(degree if highest is None else highest)
    directions = torch.randn(splats, 3) * torch.logspace(-3, 3, splats)[:, None]
    coefficients, upstream = torch.randn(splats, bases, 3), torch.randn(splats, 3)
    results = []
    for function in (eval_sh, Harmonics.apply):
        leaves = [table.clone().requires_grad_() for table in (directions, coefficients)]
        colors = function(degree, *leaves) + 0.0 * leaves[0]  # without it the twin's degree 0 has no gradient
        results.append((colors.detach(), *torch.autograd.grad(colors, leaves, upstream)))
    (twin, twin_d, twin_k), (colors, d, k) = results
    assert_close(colors, twin, rtol=1e-5, atol=1e-5)
    assert_close(k, twin_k, rtol=1e-5, atol=1e-5)
    scale = directions.norm(dim=1, keepdim=True)  # gradients fall with the length
    assert_close(d * scale, twin_d * scale, rtol=1e-4, atol=1e-4)


def test_a_direction_of_no_length_is_finite():
    direction, coefficients = torch.zeros(1, 3, requires_grad=True), torch.ones(1, 16, 3, requires_grad=True)
    Harmonics.apply(3, direction, coefficients).sum().backward()
    assert torch.isfinite(direction.grad).all() and torch.isfinite(coefficients.grad).all()
