# SPDX-License-Identifier: Apache-2.0
"""The kernels of spherical harmonics in Triton's interpreter against their twin.

Run by kernels/test_interpreted.py.
"""

import pytest
import quick_interpreter  # noqa: F401
import torch
from torch.testing import assert_close

from nrfgs_ns.appearance.harmonics_triton import Harmonics
from nrfgs_ns.appearance.sh import eval_sh, num_bases


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize(("splats", "highest"), [(1, 3), (200, 3), (130, None)])
def test_colours_and_gradients_are_those_of_the_twin(degree, splats, highest):
    """On a CPU `eval_sh` is the twin."""
    torch.manual_seed(degree)
    bases = num_bases(degree if highest is None else highest)
    directions = torch.randn(splats, 3) * torch.logspace(-3, 3, splats)[:, None]
    coefficients, upstream = torch.randn(splats, bases, 3), torch.randn(splats, 3)
    found = []
    for function in (eval_sh, Harmonics.apply):
        leaves = [table.clone().requires_grad_() for table in (directions, coefficients)]
        colors = function(degree, *leaves)
        colors.backward(upstream)
        by_directions, by_coefficients = (leaf.grad for leaf in leaves)
        found.append((colors.detach(), by_coefficients, torch.zeros(1, 3) if by_directions is None else by_directions))
    (twin, twin_coefficients, twin_directions), (mine, mine_coefficients, mine_directions) = found
    assert_close(mine, twin, rtol=1e-5, atol=1e-5)
    assert_close(mine_coefficients, twin_coefficients, rtol=1e-5, atol=1e-5)
    scale = directions.norm(dim=1, keepdim=True)  # gradients fall with the length
    assert_close(
        mine_directions * scale, (twin_directions + torch.zeros_like(directions)) * scale, rtol=1e-4, atol=1e-4
    )


def test_nothing_is_nothing():
    assert Harmonics.apply(3, torch.zeros(0, 3), torch.zeros(0, 16, 3)).shape == (0, 3)


def test_a_direction_of_no_length_is_finite():
    direction, coefficients = torch.zeros(1, 3, requires_grad=True), torch.ones(1, 16, 3, requires_grad=True)
    Harmonics.apply(3, direction, coefficients).sum().backward()
    assert torch.isfinite(direction.grad).all() and torch.isfinite(coefficients.grad).all()
