# SPDX-License-Identifier: Apache-2.0
"""The colour fit: exact where the truth is an affine map of the prediction, the best of all maps otherwise."""

import torch

from nrfgs_ns.image.color_fit import fit_colors


def test_undoes_an_affine_change_of_colours():
    truth = torch.rand(20, 30, 3) * 0.6 + 0.2
    pred = truth @ torch.tensor([[0.8, 0.1, 0.0], [0.0, 0.7, 0.05], [0.1, 0.0, 0.9]]) + 0.03
    torch.testing.assert_close(fit_colors(pred, truth), truth, atol=1e-5, rtol=0)


def test_no_other_map_is_nearer():
    torch.manual_seed(0)
    truth, pred = torch.rand(16, 16, 3), torch.rand(16, 16, 3)
    best = (fit_colors(pred, truth) - truth).square().mean()
    assert best <= (pred - truth).square().mean()
    for _ in range(20):
        other = (pred @ (torch.eye(3) * 0.1 + 0.05 * torch.randn(3, 3)) + 0.45 + 0.05 * torch.randn(3)).clamp(0, 1)
        assert best <= (other - truth).square().mean()


def test_only_what_is_inside_the_mask_counts():
    truth = torch.rand(12, 12, 3) * 0.5 + 0.25
    pred, mask = truth * 0.5 + 0.1, torch.zeros(12, 12, 1, dtype=torch.bool)
    mask[3:9, 3:9] = True
    pred = torch.where(mask, pred, torch.zeros_like(pred))
    fitted = fit_colors(pred, truth, mask)
    torch.testing.assert_close(fitted[3:9, 3:9], truth[3:9, 3:9], atol=1e-5, rtol=0)


def test_one_colour_nothing_inside_and_nan():
    truth, flat = torch.rand(5, 5, 3), torch.full((5, 5, 3), 0.4)
    torch.testing.assert_close(fit_colors(flat, truth), truth.mean((0, 1)).expand(5, 5, 3), atol=1e-5, rtol=0)
    assert fit_colors(flat, truth, torch.zeros(5, 5, 1, dtype=torch.bool)) is flat
    flat[0, 0, 0] = torch.nan
    assert fit_colors(flat, truth) is flat
