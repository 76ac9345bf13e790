# SPDX-License-Identifier: Apache-2.0
"""The loss's kernels in Triton's interpreter against pytorch_msssim in float64.

A row of a program takes about a tenth of a second there, hence the small images
and blocks.
"""

import quick_interpreter  # noqa: F401
from ssim_cases import TOLERANCE, assert_near, pair

from nrfgs_ns.image import ssim_triton
from nrfgs_ns.image.ssim import photometric_loss


def test_several_blocks_and_strips(monkeypatch):
    """Windows cross the borders of two blocks of columns and of two strips of rows."""
    monkeypatch.setattr(ssim_triton, "COLUMNS", 32)
    monkeypatch.setattr(ssim_triton, "ROWS", 6)
    prediction, truth = pair(12, 18)
    loss = ssim_triton.WeightedSum.apply(prediction, truth, 0.8, -0.2, 0.2)
    assert_near(loss, prediction, truth, 0.2, TOLERANCE)


def test_one_window_and_upstream_gradient(monkeypatch):
    monkeypatch.setattr(ssim_triton, "COLUMNS", 64)
    monkeypatch.setattr(ssim_triton, "ROWS", 11)
    prediction, truth = pair(11, 11)
    got = ssim_triton.WeightedSum.apply(prediction, truth, 0.0, -1.0, 1.0)
    (3.0 * got).backward()
    twin = prediction.detach().double().requires_grad_()
    expected = photometric_loss(twin, truth.double(), 1.0)
    (3.0 * expected).backward()
    assert (got.double() - expected).abs() <= TOLERANCE
    assert (prediction.grad - twin.grad).abs().max() <= TOLERANCE * twin.grad.abs().max()
