# SPDX-License-Identifier: Apache-2.0
"""Smaller fields: exact where they claim to be, and equal to what the parts' own definition says."""

import pytest
import torch
from head_cases import assert_same, awake, scene
from torch.testing import assert_close

from nrfgs_lab.residuals import with_diffuse
from nrfgs_ns.appearance.field import DIFFUSE, Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.reduce import latent_basis, with_rank

CONFIGS = {
    "default": NrfConfig(latent_dim=8, hidden_width=16),
    "one branch": NrfConfig(latent_dim=8, hidden_width=16, split_bands=False),
    "low only": NrfConfig(latent_dim=8, hidden_width=16, num_bands=1, use_distance=False, opacity_residual=False),
}


@pytest.fixture(params=CONFIGS)
def case(request):
    head = awake(CONFIGS[request.param], torch.float32).requires_grad_(False)
    splats, visible, centers = scene(head, count=40, dtype=torch.float32)
    return Field(head, splats), visible, centers


def test_full_rank_is_the_head(case):
    field, visible, centers = case
    basis = latent_basis(field, torch.rand(40))
    whole = with_rank(field, basis, 8)
    assert (whole.splats["latents"] - field.splats["latents"]).abs().max() > 0.01, "the basis must have turned"
    assert_same(whole, field, visible, centers)


def test_components_predict_the_hidden_units_better_the_more_there_are(case):
    field, _, _ = case
    weight = torch.rand(40) ** 4
    basis = latent_basis(field, weight)
    layers = [branch[0].weight[:, :8] for branch in (field.head.low, field.head.high) if branch is not None]
    first = torch.cat(layers).double()
    centred = field.splats["latents"].double() - basis.mean

    def error(latents):
        return (weight[:, None] * ((latents - centred) @ first.T).square()).sum() / weight.sum()

    errors = []
    for rank in range(1, 9):
        reduced = (centred @ basis.inverse[:rank].T) @ basis.axes[:, :rank].T
        errors.append(error(reduced).item())
        # What is left is the variance of the components that were left out.
        assert errors[-1] == pytest.approx(basis.variances[rank:].sum().item(), rel=1e-6, abs=1e-9)
    assert errors == sorted(errors, reverse=True) and errors[0] > errors[-2] > 1e-6
    torch.manual_seed(0)
    for rank in (1, 3, 6):  # no other subspace does better
        for _ in range(20):
            axes, _ = torch.linalg.qr(torch.randn(8, rank, dtype=torch.float64))
            codes = torch.linalg.lstsq(first @ axes, (centred @ first.T).T).solution
            assert error((axes @ codes).T) >= errors[rank - 1] * (1 - 1e-9)


def test_latents_in_a_subspace_need_no_more(case):
    field, visible, centers = case
    torch.manual_seed(0)
    flat = torch.randn(40, 3) @ torch.randn(3, 8) * 0.5 + torch.randn(8)
    field = Field(field.head, {**field.splats, "latents": flat})
    small = with_rank(field, latent_basis(field, torch.ones(40)), 3)
    assert small.splats["latents"].shape == (40, 3) and small.head.config.latent_dim == 3
    assert_same(small, field, visible, centers, atol=1e-4)  # numbers up to 5 here, 2^-24 of them 60 times
    assert small.bytes < field.bytes


def test_diffuse_splats_have_what_they_are_given(case):
    field, visible, centers = case
    diffuse = torch.rand(40, generator=torch.Generator().manual_seed(0)) < 0.5
    base = {"features_dc": torch.randn(40, 3), "opacities": torch.randn(40, 1)}
    small = with_diffuse(field, diffuse, **base)
    found, full = small.head(small.splats, visible, centers), field.head(field.splats, visible, centers)
    given = field.head.base_appearance({**field.splats, **base}, visible)
    is_diffuse = diffuse[visible]
    assert is_diffuse.any() and not is_diffuse.all()
    for a, b, c in zip(found, full, given, strict=True):
        assert (a[is_diffuse] == c[is_diffuse]).all()
        assert_close(a[~is_diffuse], b[~is_diffuse], rtol=0, atol=1e-6)  # other sizes of a product, other rounding
    saved = int(diffuse.sum()) * 8 * 4 - 40 // 8
    assert small.bytes == field.bytes - saved


def test_the_head_is_evaluated_for_the_others_only(case):
    """A latent of NaN would show; and what does not count gets no gradient."""
    field, visible, centers = case
    diffuse = torch.arange(40) % 3 == 0
    splats = {**field.splats, DIFFUSE: diffuse}
    splats["latents"] = field.splats["latents"].clone()
    splats["latents"][diffuse] = torch.nan
    splats["latents"].requires_grad_()
    one_center = torch.tensor([1.0, 2.0, 3.0])
    for center in (centers, one_center):
        found = field.head(splats, visible, center)
        assert torch.isfinite(found.colors).all() and torch.isfinite(found.opacities).all()
        for name, (values, _) in field.head.components(splats, visible, center).items():
            assert len(values) == len(visible) and (values[diffuse[visible]] == 0).all(), name
    (gradient,) = torch.autograd.grad(found.colors.sum(), splats["latents"])
    assert (gradient[diffuse] == 0).all()
    seen = torch.zeros(40, dtype=torch.bool).index_fill(0, visible, True)
    assert gradient[seen & ~diffuse].abs().sum() > 0


def test_nobody_visible_and_all_diffuse_are_fine(case):
    field, visible, centers = case
    for diffuse in (torch.zeros(40, dtype=torch.bool), torch.ones(40, dtype=torch.bool)):
        splats = {**field.splats, DIFFUSE: diffuse}
        assert field.head(splats, visible[:0], centers[:0]).colors.shape == (0, 3)
        assert field.head(splats, visible, centers).opacities.shape == (len(visible),)
