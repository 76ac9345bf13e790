# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from head_cases import awake, numbers_per_splat, scene, shared_weights
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
def test_sizes(lobes):
    head = SgConfig(lobes=lobes).setup()
    assert numbers_per_splat(head) == 3 + 7 * lobes
    assert shared_weights(head) == 0
    assert numbers_per_splat(SgConfig().setup()) == 24


@pytest.mark.parametrize("lobes", [1, 3, 6])
def test_matches_the_formula(lobes):
    head = awake(SgConfig(lobes=lobes))
    splats, visible, centers = scene(head)
    splats["sg_sharpness"][::2] *= -1
    colors, opacities = head(splats, visible, centers)
    assert_close(colors, by_hand(splats, visible, centers), rtol=0, atol=1e-13)
    assert_close(opacities, torch.sigmoid(splats["opacities"][visible, 0]))


def seen_along(direction, **changes):
    """Colour of one splat with three lobes of white, as they start, looked at along `direction`."""
    head = SgConfig().setup()
    splats = {"means": torch.zeros(1, 3), "opacities": torch.zeros(1, 1), **head.splat_params(torch.zeros(1, 3))}
    splats["sg_colors"][:] = torch.eye(3)  # lobe x is red, y green, z blue
    splats |= changes
    return head(splats, torch.tensor([0]), -torch.tensor(direction)).colors[0].tolist()


def test_start():
    """Axes x, y, z, at 1 on the axis, 56 % halfway to the next, 2 % opposite; looking along +x, from the camera."""
    red, green, blue = seen_along([2.0, 0.0, 0.0])
    assert red == pytest.approx(1.0) and green == blue == pytest.approx(math.exp(-2.0))
    assert seen_along([1.0, 1.0, 0.0])[:2] == pytest.approx([0.557, 0.557], abs=1e-3)
    assert seen_along([0.0, 0.0, -1.0])[2] == pytest.approx(0.018, abs=1e-3)


def test_length_of_an_axis_and_sign_of_the_sharpness_do_not_matter():
    direction = [1.0, 2.0, -0.5]
    axes = torch.eye(3)[None] * torch.tensor([5.0, 0.1, 100.0])[:, None]
    expected = pytest.approx(seen_along(direction), abs=1e-6)  # float32: ten units of 1
    assert seen_along(direction, sg_axes=axes) == expected
    assert seen_along(direction, sg_sharpness=torch.full((1, 3), -2.0)) == expected


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


def test_no_two_lobes_start_alike():
    axes = SgConfig(lobes=6).setup().splat_params(torch.zeros(1, 3))["sg_axes"][0]
    assert len(axes.unique(dim=0)) == 6
    assert torch.equal(axes[:3], torch.eye(3))


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
