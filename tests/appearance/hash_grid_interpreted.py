# SPDX-License-Identifier: Apache-2.0
"""The hash grid's kernels in Triton's interpreter against PyTorch's grid in float64.

Run by kernels/test_interpreted.py.
"""

import pytest
import quick_interpreter  # noqa: F401
import torch
from hash_grid_cases import assert_near_twin, grids, positions

from nrfgs_ns.appearance import hash_grid_triton
from nrfgs_ns.appearance.hash_grid_triton import Interpolation


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(hash_grid_triton, "POSITIONS", 64)


def interpolate(grid, x):
    return Interpolation.apply(x, grid.table, grid.resolutions, len(grid.sides), grid.table_size)


@pytest.mark.parametrize("features", [1, 2, 4])
def test_values_and_gradients(features):
    assert_near_twin(*grids(features=features), positions(60), interpolate)  # a part of a block


@pytest.mark.parametrize("count", [0, 1, 65])
def test_counts_around_a_block(count):
    assert_near_twin(*grids(levels=1), positions(count), interpolate)


@pytest.mark.parametrize(
    "options, numbered",
    [
        ({"levels": 2, "log2_table_size": 1, "features": 8}, 0),
        ({"levels": 4, "log2_table_size": 15, "base_resolution": 16}, 1),  # the paper's: 16, 24, 36, 54
    ],
)
def test_levels_of_either_kind(options, numbered):
    grid, twin = grids(**options)
    assert len(grid.sides) == numbered
    assert_near_twin(grid, twin, positions(30), interpolate)


def test_tensors_that_are_not_contiguous():
    grid, twin = grids(levels=1)
    x = positions(3 * 20).view(20, 9)[:, ::3].detach().requires_grad_()
    assert not x.is_contiguous()
    assert_near_twin(grid, twin, x, interpolate)
    interpolate(grid, x).sum().backward()  # its gradient is one number, expanded
    assert torch.isfinite(x.grad).all() and (x.grad != 0).all()


@pytest.mark.parametrize("wanted", [0, 1])
def test_one_gradient_alone(wanted):
    """The tensor passed in place of the other stays as it is. Equal to the last bit: the interpreter runs one program
    after the other, so that even the table's gradient is added up in one order."""
    grid, _ = grids()
    leaves = positions(70).requires_grad_(), grid.table  # two blocks
    upstream = torch.randn(70, grid.width, generator=torch.Generator().manual_seed(7))
    (expected,) = torch.autograd.grad(interpolate(grid, leaves[0]), leaves[wanted], upstream)
    leaves[1 - wanted].requires_grad_(False)
    before = leaves[1 - wanted].clone()
    (gradient,) = torch.autograd.grad(interpolate(grid, leaves[0]), leaves[wanted], upstream)
    assert torch.equal(gradient, expected) and torch.equal(leaves[1 - wanted], before)


@pytest.mark.filterwarnings("ignore:invalid value")  # numpy's; it is the case's
def test_what_is_no_lattice_coordinate():
    """Beyond 2^31 steps features are those of one lattice point; what is no number makes its own features none."""
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
