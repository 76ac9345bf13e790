# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from gsplat.cuda._torch_impl import _eval_sh_bases_fast
from head_cases import awake, scene
from torch.testing import assert_close

from nrfgs_ns.appearance.gsnb import GsnbConfig


def by_hand(head, splats, visible, centers, ramp):
    """The formulas, one splat at a time, with nothing shared with the implementation but the weights."""
    first, _, second, _, third, _ = head.basis
    colors = []
    for row, center in zip(visible.tolist(), centers, strict=True):
        x = splats["means"][row]
        d = (x - center) / (x - center).norm()
        waves = [[torch.sin(2**k * math.pi * d), torch.cos(2**k * math.pi * d)] for k in range(6)]
        h = torch.cat([d] * head.config.raw_direction + sum(waves, []))
        for layer in (first, second):
            h = layer.weight @ h + layer.bias
            h = torch.where(h > 0, h, 0.01 * h)
        phi = torch.tanh(third.weight @ h + third.bias)
        k = torch.cat([splats["features_dc"][row][None], splats["features_rest"][row]])
        color = 0.5 + sum((_eval_sh_bases_fast(16, d)[j] + ramp * phi[j]) * k[j] for j in range(16))
        colors.append(color.clamp_min(0))
    return torch.stack(colors)


@pytest.mark.parametrize("raw, step, ramp", [(True, 3000, 0.6), (True, 5000, 1.0), (False, 30_000, 1.0)])
def test_matches_the_formulas(raw, step, ramp):
    head = awake(GsnbConfig(raw_direction=raw))
    head.set_step(step)
    splats, visible, centers = scene(head)
    colors, opacities = head(splats, visible, centers)
    assert_close(colors, by_hand(head, splats, visible, centers, ramp), rtol=0, atol=1e-12)
    assert_close(opacities, torch.sigmoid(splats["opacities"][visible, 0]))


def test_learnt_functions_use_the_coefficients_of_degrees_that_are_still_off():
    head = awake(GsnbConfig())
    head.set_step(500)
    assert head.active_degree == 0
    splats, visible, centers = scene(head)
    splats["features_rest"].requires_grad_()
    head(splats, visible, centers).colors.sum().backward()
    assert (splats["features_rest"].grad[visible] != 0).any(dim=0).all()
