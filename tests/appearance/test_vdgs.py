# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from gsplat.cuda._torch_impl import _eval_sh_bases_fast
from head_cases import awake, scene
from torch.testing import assert_close

from nrfgs_ns.appearance.hash_grid import HashGrid
from nrfgs_ns.appearance.vdgs import VdgsConfig


def grid_by_hand(table, x):
    """The paper's four levels at one position, corner by corner, the hash in unsigned 32-bit integers."""
    features = []
    for level, resolution in enumerate((16, 24, 36, 54)):
        scaled = [float(coordinate) * resolution for coordinate in x]
        total = torch.zeros(4, dtype=torch.float64)
        for corner in range(8):
            weight, point = 1.0, []
            for axis in range(3):
                upper = corner >> axis & 1
                below = math.floor(scaled[axis])
                weight *= scaled[axis] - below if upper else 1 - (scaled[axis] - below)
                point.append(below + upper)
            i, j, k = point
            if level == 0:  # 32 points per side fill the table
                row = i % 32 + 32 * (j % 32) + 1024 * (k % 32)
            else:
                u, v, w = (c * p % 2**32 for c, p in zip(point, (1, 2654435761, 805459861), strict=True))
                row = (u ^ v ^ w) % 2**15
            total = total + weight * table[level * 2**15 + row]
        features.append(total)
    return torch.cat(features)


def by_hand(head, splats, visible, centers):
    """The formulas, one splat at a time, with nothing shared with the implementation but the weights."""
    first, _, second, _, third = head.network
    colors, opacities = [], []
    for row, center in zip(visible.tolist(), centers, strict=True):
        x = splats["means"][row]
        d = (x - center) / (x - center).norm()
        h = torch.cat([d, grid_by_hand(head.grid.table, x)])
        for layer in (first, second):
            h = layer.weight @ h + layer.bias
            h = torch.where(h > 0, h, 0.01 * h)
        f = 1 / (1 + torch.exp(-(third.weight @ h + third.bias)))
        k = torch.cat([splats["features_dc"][row][None], splats["features_rest"][row]])
        alpha = f[0] / (1 + torch.exp(-splats["opacities"][row, 0]))
        colors.append((0.5 + _eval_sh_bases_fast(16, d) @ k).clamp_min(0))
        opacities.append(alpha)
    return torch.stack(colors), torch.stack(opacities)


def test_matches_the_formulas():
    head = awake(VdgsConfig())
    splats, visible, centers = scene(head, count=18)
    assert (splats["means"][visible].abs() > 1).any() and (splats["means"][visible] < 0).any()
    colors, opacities = head(splats, visible, centers)
    expected_colors, expected_opacities = by_hand(head, splats, visible, centers)
    assert_close(colors, expected_colors, rtol=0, atol=1e-12)
    assert_close(opacities, expected_opacities, rtol=0, atol=1e-12)


def test_what_the_view_takes_from_opacity_can_be_shown():
    head = awake(VdgsConfig())
    splats, visible, centers = scene(head)
    parts = head.components(splats, visible, centers)
    change = parts["opacity residual"]
    shown, stored = head(splats, visible, centers), torch.sigmoid(splats["opacities"][visible])
    assert change.kind == "opacity" and torch.equal(change.values, shown.opacities[:, None] - stored)
    assert (change.values < 0).all() and change.values.std() > 0.01
    assert torch.equal(parts["residual"].values, shown.colors - head.base_appearance(splats, visible).colors)


@pytest.fixture
def grid():
    torch.manual_seed(0)
    grid = HashGrid(16).double()
    grid.table.data.normal_()
    return grid


@pytest.mark.parametrize("axis", range(3))
def test_features_are_continuous_across_cells_zero_and_the_cube(axis, grid):
    x = torch.rand(40, 3, dtype=torch.double) * 2 - 1
    x[:, axis] = torch.arange(-20, 20) / 16  # faces of cells on level 0, of some on the others
    before, after = x.clone(), x.clone()
    before[:, axis] -= 1e-9
    after[:, axis] += 1e-9
    # A feature changes by at most 54 steps per unit times the largest difference of two normal numbers among 2^19.
    assert (grid(after) - grid(before)).abs().max() < 2e-9 * 54 * 10


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_far_splats_find_rows_too(dtype, grid):
    far = torch.tensor([[1e6, -1e6, 1e6], [-1e9, 1e9, 0.1], [1e30, -1e30, 0.0]], dtype=dtype)
    features = grid.to(dtype)(far)
    assert torch.isfinite(features).all() and (features != 0).any(dim=1).all()
