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
    monkeypatch.setattr(hash_grid_triton, "BLOCK", 64)


def interpolate(grid, x):
    return Interpolation.apply(x, grid.table, grid.resolutions, len(grid.sides), grid.table_size)


@pytest.mark.parametrize(
    "count, options, numbered",
    [
        (0, {"levels": 1}, 1),
        (65, {"levels": 1}, 1),  # one more than a block
        (60, {}, 2),
        (30, {"levels": 2, "log2_table_size": 1}, 0),
        (30, {"levels": 4, "log2_table_size": 15, "base_resolution": 16}, 1),  # the paper's: 16, 24, 36, 54
    ],
)
def test_values_and_gradients(count, options, numbered):
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
