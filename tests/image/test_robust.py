# SPDX-License-Identifier: Apache-2.0
"""Trimming: what moved is left out, single pixels and clean photographs are not."""

import pytest
import torch

from nrfgs_ns.image.robust import FADE_STEPS, FIRST_STEP, Trimming

END = FIRST_STEP + FADE_STEPS


def test_a_clean_photograph_among_dirty_ones_keeps_more_than_its_share():
    torch.manual_seed(0)
    trimming, truth = Trimming(0.3), torch.full((30, 30, 3), 0.5)
    dirty = truth.clone()
    dirty[:10] += 0.3
    for _ in range(30):
        trimming(dirty + 0.01 * torch.randn_like(truth), truth, END)
    assert trimming(truth + 0.01 * torch.randn_like(truth), truth, END).mean() == 1.0


def test_nothing_is_trimmed_of_a_clean_capture():
    """Residuals of a fit have a long tail, and the largest tenth lie together; they are not five times the median."""
    torch.manual_seed(0)
    trimming, truth = Trimming(0.1), torch.full((60, 60, 3), 0.5)
    hard = torch.full((60, 60, 1), 0.03)
    hard[:20, :20] = 0.1
    for _ in range(20):
        kept = trimming(truth + hard * torch.randn_like(truth), truth, END)
    assert kept.mean() > 0.995


def test_a_thin_line_is_kept_and_a_body_is_not():
    trimming, truth = Trimming(0.2), torch.full((200, 200, 3), 0.5)
    fitted = truth + 0.01 * torch.randn(200, 200, 3, generator=torch.Generator().manual_seed(0))
    line, body = fitted.clone(), fitted.clone()
    line[:, 100:102] += 0.4
    body[60:140, 80:120] += 0.4
    for _ in range(30):
        trimming(fitted, truth, END)
    assert trimming(line, truth, END).min() == 1.0
    kept = trimming(body, truth, END)
    assert kept.shape == (200, 200, 1) and kept[64:136, 84:116].sum() == 0 and kept.mean() > 0.9
    kept[58:142, 78:122] = 1
    assert kept.mean() > 0.99


def test_trimmed_pixels_lose_their_weight_little_by_little():
    truth = torch.full((60, 60, 3), 0.2)
    walked_through = truth.clone()
    walked_through[20:50, 20:50] += 0.5
    weights = []
    for step in (FIRST_STEP, FIRST_STEP + FADE_STEPS // 4, END, END + 1000):
        weights.append(Trimming(0.3)(walked_through, truth, step)[35, 35, 0].item())
    assert weights == pytest.approx([1.0, 0.75, 0.0, 0.0])


def test_what_is_outside_the_mask_is_not_remembered():
    one, other, truth = Trimming(0.5), Trimming(0.5), torch.rand(8, 8, 3)
    mask = torch.zeros(8, 8, 1)
    mask[:4] = 1
    pred = (truth + 0.1).clamp(0, 1)
    spoilt = torch.where(mask > 0, pred, 1 - truth)
    one(pred, truth, END, mask)
    other(spoilt, truth, END, mask)
    assert torch.equal(one.histogram, other.histogram)
    assert one.histogram.sum() == 32
