# SPDX-License-Identifier: Apache-2.0
"""The hash grid's kernels on a CUDA device against PyTorch's grid in float64. `pytest -m gpu`."""

import pytest
import torch
from hash_grid_cases import assert_near_twin, grids, positions

pytestmark = pytest.mark.gpu

PAPER = {"levels": 4, "log2_table_size": 15, "base_resolution": 16}


def interpolate(grid, x):
    features = grid(x)
    assert type(features.grad_fn).__name__ == "InterpolationBackward", "the kernels must have been taken"
    return features


@pytest.mark.parametrize("options", [{}, PAPER, {"levels": 7, "log2_table_size": 6}])
@pytest.mark.parametrize("count", [0, 1, 129, 100_000])
def test_values_and_gradients(count, options):
    assert_near_twin(*grids("cuda", **options), positions(count, "cuda"), interpolate)


def test_what_is_no_lattice_coordinate():
    grid, _ = grids("cuda", **PAPER)
    wild = [[1e12, -1e12, 1e30], [-1e30] * 3, [0.1, torch.nan, 0.1], [0.1, 0.1, torch.inf], [0.3, -0.2, 0.1]]
    x = torch.tensor(wild, device="cuda", requires_grad=True)
    features = interpolate(grid, x)
    features.sum().backward()
    assert features[2:4].isnan().all()
    assert torch.isfinite(features[[0, 1, 4]]).all() and torch.isfinite(x.grad[[0, 1, 4]]).all()
