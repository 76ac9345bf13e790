# SPDX-License-Identifier: Apache-2.0
"""Splatfacto's loss, (1 - lambda) L1 + lambda (1 - SSIM), in few operations and without permuted copies.

SSIM is Wang et al.'s of 2004 as pytorch_msssim computes it: moments under an 11 x 11 Gaussian of sigma 1.5, at all
places where the window lies within the image, mean over places and channels. With a prediction x and a truth y,

    S = A B / (C D)     A = 2 E[x] E[y] + C1        B = 2 (E[xy] - E[x] E[y]) + C2
                        C = E[x]^2 + E[y]^2 + C1    D = (E[xx] - E[x]^2) + (E[yy] - E[y]^2) + C2

The window is symmetric, so the gradient by x is blur(dS/dE[x]) + 2 x blur(dS/dE[xx]) + y blur(dS/dE[xy]): forward keeps
those three slopes and no moments. On CUDA one Triton kernel does each direction, in float32 (`ssim_triton.py`).
"""

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.image.metrics import LIBRARY, SSIM_C1, SSIM_C2, WEIGHTS, WINDOW_SIZE, blur
from nrfgs_ns.kernels.trial import tried_once


def photometric_loss(prediction: Tensor, truth: Tensor, ssim_lambda: float) -> Tensor:
    """(1 - ssim_lambda) mean |prediction - truth| + ssim_lambda (1 - SSIM), a scalar; ssim_lambda in [0, 1].

    Images are [H, W, 3] in [0, 1]; the truth gets no gradient. Those with a side shorter than the window go to
    pytorch_msssim, which warns and leaves that side unblurred.
    """
    if min(prediction.shape[:2]) < WINDOW_SIZE:
        similarity = LIBRARY(prediction.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None])
    elif prediction.is_cuda and prediction.dtype == torch.float32 and kernels_run_on(prediction.device):
        from nrfgs_ns.image.ssim_triton import WeightedSum

        return WeightedSum.apply(prediction, truth, 1.0 - ssim_lambda, -ssim_lambda, ssim_lambda)
    else:
        similarity = SsimInTorch.apply(prediction, truth)
    total = -ssim_lambda * similarity + ssim_lambda
    return total if ssim_lambda == 1.0 else total + (1.0 - ssim_lambda) * (prediction - truth).abs().mean()


class SsimInTorch(torch.autograd.Function):
    """SSIM in PyTorch: the kernels' twin, for images with both sides at least the window's."""

    @staticmethod
    def forward(ctx, prediction: Tensor, truth: Tensor) -> Tensor:
        x, y = (image.detach().permute(2, 0, 1).contiguous() for image in (prediction, truth))
        moments = blur(torch.cat([x, y, x * x, y * y, x * y]), x.new_tensor(WEIGHTS)).split(3)
        similarity, *slopes = _similarity(*moments)
        ctx.save_for_backward(x, y, *slopes)
        return similarity.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx, d_mean: Tensor) -> tuple[Tensor, None]:
        x, y, *slopes = ctx.saved_tensors
        # With zeros around, every pixel lies in whole windows: the gradient is as large as the image.
        padded = F.pad(torch.cat(slopes), (WINDOW_SIZE - 1,) * 4)
        slope_x, slope_xx, slope_xy = blur(padded, x.new_tensor(WEIGHTS)).split(3)
        d_prediction = slope_x.addcmul(x, slope_xx, value=2.0).addcmul_(y, slope_xy).mul_(d_mean / slopes[0].numel())
        return d_prediction.permute(1, 2, 0), None


def _similarity(x: Tensor, y: Tensor, xx: Tensor, yy: Tensor, xy: Tensor) -> tuple[Tensor, ...]:
    """S and its slopes by E[x], E[xx], E[xy], from the moments; all [3, h, w]."""
    product, squares = x * y, x * x + y * y
    A, B = 2 * product + SSIM_C1, 2 * (xy - product) + SSIM_C2
    C, D = squares + SSIM_C1, xx + yy - squares + SSIM_C2
    scale = 1 / (C * D)
    S = A * B * scale
    slope_xx, slope_xy = -S / D, 2 * A * scale
    slope_x = 2 * (y * B * scale - x * (S / C + slope_xx)) - y * slope_xy
    return S, slope_x, slope_xx, slope_xy


@tried_once("SSIM")
def kernels_run_on(device: torch.device) -> bool:
    """Whether Triton's kernels run on a CUDA device."""
    from nrfgs_ns.image.ssim_triton import WeightedSum

    image = torch.zeros(WINDOW_SIZE, WINDOW_SIZE, 3, device=device, requires_grad=True)
    WeightedSum.apply(image, torch.zeros_like(image), 0.5, 0.5, 0.0).backward()
    return True
