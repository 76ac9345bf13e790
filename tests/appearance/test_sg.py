# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from head_cases import awake, scene
from torch.testing import assert_close

from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.sg import SgConfig


def by_hand(splats, visible, centers):
    """The formula, one splat and one lobe at a time, in Python's own arithmetic."""
    colors = []
    for row, center in zip(visible.tolist(), centers.tolist(), strict=True):
        v = [a - b for a, b in zip(splats["means"][row].tolist(), center, strict=True)]
        d = [a / math.hypot(*v) for a in v]
        color = [0.5 + SH_C0 * c for c in splats["features_dc"][row].tolist()]
        lobes = zip(*(splats[name][row].tolist() for name in ("sg_axes", "sg_sharpness", "sg_colors")), strict=True)
        for axis, sharpness, amplitude in lobes:
            cosine = sum(a * b for a, b in zip(axis, d, strict=True)) / math.hypot(*axis)
            height = math.exp(abs(sharpness) * (cosine - 1))
            color = [c + a * height for c, a in zip(color, amplitude, strict=True)]
        colors.append([max(0.0, c) for c in color])
    return torch.tensor(colors, dtype=torch.double)


@pytest.mark.parametrize("lobes", [1, 3, 6])
def test_matches_the_formula(lobes):
    head = awake(SgConfig(lobes=lobes))
    splats, visible, centers = scene(head)
    splats["sg_sharpness"][::2] *= -1
    colors, opacities = head(splats, visible, centers)
    assert_close(colors, by_hand(splats, visible, centers), rtol=0, atol=1e-13)
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
