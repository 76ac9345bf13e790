# SPDX-License-Identifier: Apache-2.0
"""The moves of 3DGS-MCMC: what copies look like, which rows they take, and how far noise goes."""

import pytest
import torch
from densification_cases import Table, rotations
from torch.testing import assert_close

from nrfgs_ns.densification.mcmc import add_noise, add_samples, relocate, split_evenly

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.mark.parametrize("copies", [1, 2, 3, 10, 51])
@pytest.mark.parametrize("opacity", [0.005, 0.1, 0.7, 0.99])
def test_copies_have_the_opacity_and_the_mass_of_the_one(opacity, copies):
    """n copies in one place blend to 1 - (1 - o' g)^n. Its peak must be o, and its integral along a line that of o g.

    The trapezoid rule on a smooth function that is 0 at both ends converges faster than any power of the step; with 40
    steps per standard deviation it is exact to rounding. What remains is float32 in and out: 1.2e-7 relative each, and
    10 times as much where 1 - o or o' amplifies it.
    """
    each, scale = split_evenly(torch.tensor([opacity]), torch.tensor([[0.3, 1.0, 2.0]]), torch.tensor([copies]))
    each, scale = each.double(), scale.double()
    assert_close(1 - (1 - each) ** copies, torch.tensor([opacity]).double(), rtol=5e-6, atol=0)
    x = torch.linspace(-16.0, 16.0, 1281, dtype=torch.float64)
    for axis, width in enumerate((0.3, 1.0, 2.0)):
        blended = 1 - (1 - each * torch.exp(-0.5 * (x * width / scale[0, axis]) ** 2)) ** copies
        alone = opacity * torch.exp(-0.5 * x**2)
        assert_close(torch.trapezoid(blended, x), torch.trapezoid(alone, x), rtol=5e-6, atol=0)


def test_noise_has_the_splats_shape_and_spares_what_is_visible():
    table = Table(3)
    table.splats["quats"].data = torch.randn(3, 4, generator=torch.Generator().manual_seed(1))
    table.splats["scales"].data = torch.randn(3, 3, generator=torch.Generator().manual_seed(2))
    for row, opacity in enumerate((0.0001, 0.005, 0.5)):
        table.set_opacity(row, opacity)
    before = table.splats["means"].detach().clone()
    torch.manual_seed(0)
    add_noise(table.splats, 0.1, torch.sigmoid(table.splats["opacities"].detach().flatten()))
    moved = table.splats["means"].detach() - before

    torch.manual_seed(0)
    normal = torch.randn(3, 3)
    half = rotations(table.splats["quats"]) * table.splats["scales"].detach().exp()[:, None, :]
    gate = 1 / (1 + torch.exp(100 * (torch.tensor([0.0001, 0.005, 0.5]) - 0.005)))
    expected = 0.1 * gate[:, None] * (half @ half.transpose(1, 2) @ normal[:, :, None])[..., 0]
    # float32 at values up to 10, and means of up to 2 from whose difference `moved` comes
    assert_close(moved, expected, rtol=1e-5, atol=1e-6)
    assert moved[2].abs().max() < 1e-6 < moved[1].abs().max()


def test_relocated_splats_become_copies_of_live_ones():
    table, dead = Table(50), torch.zeros(50, dtype=torch.bool)
    dead[::5] = True
    before = {name: value.detach().clone() for name, value in table.splats.items()}
    torch.manual_seed(0)
    source = relocate(table.splats, table.optimizers, dead)
    table.check()
    parents = table.splats["latents"][:, 0].long()
    assert torch.equal(source, parents)
    assert not dead[parents].any(), "a dead splat's latent is left"
    assert torch.equal(parents[~dead], torch.arange(50)[~dead])
    for name, value in table.splats.items():
        source = before[name][parents] if name not in ("opacities", "scales") else value[parents]
        assert torch.equal(value.detach(), source.detach()), name
    copies = torch.bincount(parents[dead], minlength=50)[parents] + 1
    shared = copies > 1
    opacity = torch.sigmoid(table.splats["opacities"].detach().flatten())
    assert_close(1 - (1 - opacity[shared]) ** copies[shared], torch.full((int(shared.sum()),), 0.5))
    assert torch.equal(opacity[~shared], torch.sigmoid(before["opacities"][~shared].flatten()))
    for name in ("latents", "means"):
        state = table.optimizers[name].state[table.splats[name]]
        assert state["exp_avg"][torch.unique(parents[dead])].abs().max() == 0, "a drawn splat keeps its momentum"


def test_extremes():
    table = Table(5)
    before = table.splats["latents"].detach().clone()
    assert torch.equal(relocate(table.splats, table.optimizers, torch.ones(5, dtype=torch.bool)), torch.arange(5))
    assert torch.equal(table.splats["latents"].detach(), before)
    one, many = (split_evenly(torch.tensor([0.5]), torch.ones(1, 3), torch.tensor([count])) for count in (51, 1000))
    assert torch.equal(one[0], many[0]) and torch.equal(one[1], many[1])
    opacities = torch.tensor([1e-30, 1e-8, 1.0 - 6e-8, 1.0])
    each, scales = split_evenly(opacities, torch.ones(4, 3), torch.tensor([2, 51, 51, 51]))
    assert torch.isfinite(scales).all() and (scales > 0).all()
    assert ((each >= 0) & (each <= 1)).all()


def test_added_splats_are_copies_with_fresh_moments():
    table = Table(50)
    torch.manual_seed(0)
    source = add_samples(table.splats, table.optimizers, 20)
    table.check()
    assert len(table) == 70
    assert torch.equal(source, table.splats["latents"][:, 0].long())
    parents = table.splats["latents"][:, 0].long()
    assert torch.equal(parents[:50], torch.arange(50))
    for name, value in table.splats.items():
        assert torch.equal(value[50:].detach(), value[parents[50:]].detach()), name
        assert table.optimizers[name].state[value]["exp_avg"][50:].abs().max() == 0
