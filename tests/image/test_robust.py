# SPDX-License-Identifier: Apache-2.0
"""Trimming: what moved is left out, single pixels and clean photographs are not."""

import pytest
import torch

from nrfgs_ns.image.robust import Trimming


def test_trims_what_moved_and_keeps_the_rest():
    torch.manual_seed(0)
    trimming = Trimming(0.2)
    truth = torch.rand(40, 40, 3) * 0.5
    for _ in range(20):
        clean = (truth + 0.02 * torch.randn_like(truth)).clamp(0, 1)
        trimming(clean, truth)
    walked_through = truth.clone()
    walked_through[10:20, 10:20] += 0.4
    kept = trimming(walked_through + 0.01 * torch.randn_like(truth), truth)
    assert kept.shape == (40, 40, 1)
    assert kept[11:19, 11:19].sum() == 0
    kept[9:21, 9:21] = 1
    assert kept.mean() > 0.99


def test_a_single_pixel_is_kept_by_its_neighbours():
    trimming, truth = Trimming(0.05), torch.full((21, 21, 3), 0.5)
    pred = truth.clone()
    pred[10, 10] = 1.0
    assert (trimming(pred, truth) == 1).all()


def test_a_clean_photograph_among_dirty_ones_keeps_more_than_its_share():
    torch.manual_seed(0)
    trimming, truth = Trimming(0.3), torch.full((30, 30, 3), 0.5)
    dirty = truth.clone()
    dirty[:15] += 0.3
    for _ in range(30):
        trimming(dirty + 0.01 * torch.randn_like(truth), truth)
    assert trimming(truth + 0.01 * torch.randn_like(truth), truth).mean() == 1.0


def test_what_is_outside_the_mask_is_not_remembered():
    one, other, truth = Trimming(0.5), Trimming(0.5), torch.rand(8, 8, 3)
    mask = torch.zeros(8, 8, 1)
    mask[:4] = 1
    pred = (truth + 0.1).clamp(0, 1)
    spoilt = torch.where(mask > 0, pred, 1 - truth)
    one(pred, truth, mask)
    other(spoilt, truth, mask)
    assert torch.equal(one.histogram, other.histogram)
    assert one.histogram.sum() == 32


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1])
def test_share_out_of_range(share):
    with pytest.raises(ValueError, match="above 0"):
        Trimming(share)
