# SPDX-License-Identifier: Apache-2.0
"""Images, and the loss of pytorch_msssim in float64, for the tests of the fused loss."""

import torch
from pytorch_msssim import SSIM
from torch import Tensor

ULP = 2.0**-24
MOMENT_ROUNDINGS = 16
"""Most roundings seen or expected in a moment, two weighted sums of 11 numbers up to 1; the bound is 22."""
NOISE_VARIANCE = 0.05
"""Least D of the noisy images below: uniform noise has a variance of 1/12, and both images count."""
TOLERANCE = 2 * MOMENT_ROUNDINGS * ULP / NOISE_VARIANCE
"""Relative error of S and of its slopes in float32 on noisy images: errors of two moments, divided by D."""


def pair(height: int, width: int, seed: int = 0, device: str = "cpu") -> tuple[Tensor, Tensor]:
    """A prediction with gradient and a truth, noisy, [H, W, 3], float32."""
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(height, width, 3, generator=generator)
    noise = 0.2 * torch.randn(height, width, 3, generator=generator)
    return (truth + noise).clamp(0.0, 1.0).to(device).requires_grad_(), truth.to(device)


def reference(prediction: Tensor, truth: Tensor, ssim_lambda: float) -> tuple[Tensor, Tensor]:
    """Splatfacto's loss as nerfstudio writes it, in float64, and its gradient [H, W, 3]."""
    x, y = prediction.detach().double().requires_grad_(), truth.double()
    similarity = SSIM(data_range=1.0, size_average=True, channel=3)(y.permute(2, 0, 1)[None], x.permute(2, 0, 1)[None])
    loss = (1 - ssim_lambda) * (y - x).abs().mean() + ssim_lambda * (1 - similarity)
    return loss.detach(), torch.autograd.grad(loss, x)[0]


def assert_near(loss: Tensor, prediction: Tensor, truth: Tensor, ssim_lambda: float, tolerance: float) -> None:
    """Compare a loss that is yet to be differentiated with the reference; the gradient, by its largest number."""
    expected, gradient = reference(prediction, truth, ssim_lambda)
    got = torch.autograd.grad(loss, prediction)[0]
    assert got.shape == prediction.shape
    assert (loss.double() - expected).abs() <= tolerance
    assert (got.double() - gradient).abs().max() <= tolerance * gradient.abs().max()
