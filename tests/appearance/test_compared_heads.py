# SPDX-License-Identifier: Apache-2.0
"""The compared heads (harmonics, GSNB, SG, VDGS) against gsplat, and against their formulas, written out by hand."""

import math

import pytest
import torch
from gsplat.cuda._torch_impl import _eval_sh_bases_fast, _spherical_harmonics
from head_cases import awake, scene
from torch.testing import assert_close

from nrfgs_ns.appearance.gsnb import GsnbConfig
from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.sg import SgConfig
from nrfgs_ns.appearance.sh import ShConfig, eval_sh, num_bases, sh_bases
from nrfgs_ns.appearance.vdgs import HashGrid, VdgsConfig


def unit(count):
    directions = torch.randn(count, 3, dtype=torch.double, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(directions, dim=-1)


@pytest.mark.parametrize("degree", range(5))
def test_bases_are_gsplats(degree):
    # gsplat's constants carry 13 digits or more.
    assert_close(sh_bases(degree, unit(200)), _eval_sh_bases_fast(num_bases(degree), unit(200)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", range(4))
def test_sum_ignores_higher_coefficients(degree):
    coefficients = torch.randn(50, 16, 3, dtype=torch.double)
    expected = _spherical_harmonics(degree, unit(50), coefficients)
    assert_close(eval_sh(degree, 3.0 * unit(50), coefficients), expected, rtol=0, atol=1e-12)


def test_degree_ramp_is_splatfactos():
    head = ShConfig(degree=3, degree_interval=1000).setup()
    for step, degree in ((0, 0), (999, 0), (1000, 1), (2500, 2), (3000, 3), (30_000, 3)):
        head.set_step(step)
        assert head.active_degree == degree


# GSNB.


def gsnb_by_hand(head, splats, visible, centers, ramp):
    """The formulas, one splat at a time, with nothing shared with the implementation but the weights."""
    first, _, second, _, third, _ = head.basis
    colors = []
    for row, center in zip(visible.tolist(), centers, strict=True):
        x = splats["means"][row]
        d = (x - center) / (x - center).norm()
        waves = [[torch.sin(2**k * math.pi * d), torch.cos(2**k * math.pi * d)] for k in range(6)]
        h = torch.cat([d] * head.config.raw_direction + sum(waves, []))
        for layer in (first, second):
            h = torch.nn.functional.leaky_relu(layer.weight @ h + layer.bias, 0.01)
        phi = torch.tanh(third.weight @ h + third.bias)
        k = torch.cat([splats["features_dc"][row][None], splats["features_rest"][row]])
        color = 0.5 + sum((_eval_sh_bases_fast(16, d)[j] + ramp * phi[j]) * k[j] for j in range(16))
        colors.append(color.clamp_min(0))
    return torch.stack(colors)


@pytest.mark.parametrize("raw, step, ramp", [(True, 3000, 0.6), (True, 5000, 1.0), (False, 30_000, 1.0)])
def test_gsnb_matches_the_formulas(raw, step, ramp):
    head = awake(GsnbConfig(raw_direction=raw))
    head.set_step(step)
    splats, visible, centers = scene(head)
    colors, opacities = head(splats, visible, centers)
    assert_close(colors, gsnb_by_hand(head, splats, visible, centers, ramp), rtol=0, atol=1e-12)
    assert_close(opacities, torch.sigmoid(splats["opacities"][visible, 0]))


def test_learnt_functions_use_the_coefficients_of_degrees_that_are_still_off():
    head = awake(GsnbConfig())
    head.set_step(500)
    assert head.active_degree == 0
    splats, visible, centers = scene(head)
    splats["features_rest"].requires_grad_()
    head(splats, visible, centers).colors.sum().backward()
    assert (splats["features_rest"].grad[visible] != 0).any(dim=0).all()


# SG.


def sg_by_hand(splats, visible, centers):
    """The formula, one splat and one lobe at a time, in Python's own arithmetic."""
    colors = []
    for row, center in zip(visible.tolist(), centers.tolist(), strict=True):
        v = [a - b for a, b in zip(splats["means"][row].tolist(), center, strict=True)]
        d = [a / math.hypot(*v) for a in v]
        color = [0.5 + SH_C0 * c for c in splats["features_dc"][row].tolist()]
        lobes = zip(*(splats[name][row].tolist() for name in ("sg_axes", "sg_sharpness", "sg_colors")), strict=True)
        for axis, sharpness, amplitude in lobes:
            cosine = sum(a * b for a, b in zip(axis, d, strict=True)) / math.hypot(*axis)
            color = [c + a * math.exp(abs(sharpness) * (cosine - 1)) for c, a in zip(color, amplitude, strict=True)]
        colors.append([max(0.0, c) for c in color])
    return torch.tensor(colors, dtype=torch.double)


@pytest.mark.parametrize("lobes", [1, 3, 6])
def test_sg_matches_the_formula(lobes):
    head = awake(SgConfig(lobes=lobes))
    splats, visible, centers = scene(head)
    splats["sg_sharpness"][::2] *= -1
    colors, opacities = head(splats, visible, centers)
    assert_close(colors, sg_by_hand(splats, visible, centers), rtol=0, atol=1e-13)
    assert_close(opacities, torch.sigmoid(splats["opacities"][visible, 0]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_axis_of_zero_is_finite_and_moves_on(dtype):
    head = awake(SgConfig(), dtype)
    splats, visible, centers = scene(head, dtype=dtype)
    splats["sg_axes"].zero_().requires_grad_()
    colors, _ = head(splats, visible, centers)
    colors.sum().backward()
    assert torch.isfinite(colors).all()
    gradient = splats["sg_axes"].grad[visible]
    assert (gradient != 0).any()
    # Three channels of at most 0.25 times a sharpness of at most 2.25, over the shortest axis.
    assert gradient.abs().max() <= 3 * 0.25 * 2.25 / 1e-3


def test_lobes_start_as_nothing_and_can_be_learnt():
    head = SgConfig().setup()
    splats = {"means": torch.rand(5, 3), "opacities": torch.zeros(5, 1), **head.splat_params(torch.rand(5, 3))}
    splats["sg_colors"].requires_grad_()
    visible, center = torch.arange(5), torch.tensor([0.0, -3.0, 1.0])
    colors = head(splats, visible, center).colors
    assert torch.equal(colors, head.base_appearance(splats, visible).colors)
    colors.sum().backward()
    assert (splats["sg_colors"].grad > 0).all()


def test_before_its_step_there_is_the_base_alone_and_no_gradient_to_the_lobes():
    head = awake(SgConfig())
    splats, visible, centers = scene(head)
    splats = {name: value.requires_grad_() for name, value in splats.items()}
    head.set_step(1999)
    colors = head(splats, visible, centers).colors
    assert torch.equal(colors, head.base_appearance(splats, visible).colors)
    colors.sum().backward()
    assert all(splats[name].grad is None for name in ("sg_axes", "sg_sharpness", "sg_colors"))
    head.set_step(2000)
    assert not torch.allclose(head(splats, visible, centers).colors, colors)


# VDGS.


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


def vdgs_by_hand(head, splats, visible, centers):
    """The formulas, one splat at a time, with nothing shared with the implementation but the weights."""
    first, _, second, _, third = head.network
    colors, opacities = [], []
    for row, center in zip(visible.tolist(), centers, strict=True):
        x = splats["means"][row]
        d = (x - center) / (x - center).norm()
        h = torch.cat([d, grid_by_hand(head.grid.table, x)])
        for layer in (first, second):
            h = torch.nn.functional.leaky_relu(layer.weight @ h + layer.bias, 0.01)
        f = 1 / (1 + torch.exp(-(third.weight @ h + third.bias)))
        k = torch.cat([splats["features_dc"][row][None], splats["features_rest"][row]])
        alpha = f[0] / (1 + torch.exp(-splats["opacities"][row, 0]))
        colors.append((0.5 + _eval_sh_bases_fast(16, d) @ k).clamp_min(0))
        opacities.append(alpha)
    return torch.stack(colors), torch.stack(opacities)


def test_vdgs_matches_the_formulas_and_shows_what_the_view_takes_from_opacity():
    head = awake(VdgsConfig())
    splats, visible, centers = scene(head, count=18)
    assert (splats["means"][visible].abs() > 1).any() and (splats["means"][visible] < 0).any()
    colors, opacities = head(splats, visible, centers)
    expected_colors, expected_opacities = vdgs_by_hand(head, splats, visible, centers)
    assert_close(colors, expected_colors, rtol=0, atol=1e-12)
    assert_close(opacities, expected_opacities, rtol=0, atol=1e-12)
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
    features = grid.to(dtype)(torch.tensor([[1e6, -1e6, 1e6], [-1e9, 1e9, 0.1], [1e30, -1e30, 0.0]], dtype=dtype))
    assert torch.isfinite(features).all() and (features != 0).any(dim=1).all()
