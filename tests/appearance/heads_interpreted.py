# SPDX-License-Identifier: Apache-2.0
"""The kernels of harmonics in Triton's interpreter against their twin."""

import pytest
import quick_interpreter  # noqa: F401
import torch
from torch.testing import assert_close

from nrfgs_ns.appearance.harmonics_triton import Harmonics
from nrfgs_ns.appearance.sh import eval_sh, num_bases


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
