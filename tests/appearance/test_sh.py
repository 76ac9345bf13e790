# SPDX-License-Identifier: Apache-2.0
import pytest
import torch
from gsplat.cuda._torch_impl import _eval_sh_bases_fast, _spherical_harmonics
from torch.testing import assert_close

from nrfgs_ns.appearance.sh import ShConfig, eval_sh, num_bases, sh_bases


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


def test_impossible_degree_is_named():
    with pytest.raises(ValueError, match="appearance.degree is 4"):
        ShConfig(degree=4).setup()
