# SPDX-License-Identifier: Apache-2.0
"""Smaller fields: exact where they claim to be, and equal to what the parts' own definition says."""

import pytest
import torch
from head_cases import assert_same, random_field

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.reduce import latent_basis, with_rank

CONFIGS = {
    "default": NrfConfig(latent_dim=8, hidden_width=16),
    "one branch": NrfConfig(latent_dim=8, hidden_width=16, split_bands=False),
    "low only": NrfConfig(latent_dim=8, hidden_width=16, num_bands=1, use_distance=False, opacity_residual=False),
}


@pytest.fixture(params=CONFIGS)
def case(request):
    return random_field(CONFIGS[request.param])


def test_full_rank_is_the_head_and_latents_in_a_subspace_need_no_more(case):
    field, visible, centers = case
    whole = with_rank(field, latent_basis(field, torch.rand(40)), 8)
    assert (whole.splats["latents"] - field.splats["latents"]).abs().max() > 0.01, "the basis must have turned"
    assert_same(whole, field, visible, centers)
    torch.manual_seed(0)
    flat = torch.randn(40, 3) @ torch.randn(3, 8) * 0.5 + torch.randn(8)
    field = Field(field.head, {**field.splats, "latents": flat})
    small = with_rank(field, latent_basis(field, torch.ones(40)), 3)
    assert small.splats["latents"].shape == (40, 3) and small.head.config.latent_dim == 3
    assert_same(small, field, visible, centers, atol=1e-4)  # numbers up to 5 here, 2^-24 of them 60 times


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
        errors.append(error((centred @ basis.inverse[:rank].T) @ basis.axes[:, :rank].T).item())
    assert errors == sorted(errors, reverse=True) and errors[0] > errors[-2] > 1e-6
    torch.manual_seed(0)
    for rank in (1, 3, 6):  # no other subspace does better
        for _ in range(20):
            axes, _ = torch.linalg.qr(torch.randn(8, rank, dtype=torch.float64))
            codes = torch.linalg.lstsq(first @ axes, (centred @ first.T).T).solution
            assert error((axes @ codes).T) >= errors[rank - 1] * (1 - 1e-9)
