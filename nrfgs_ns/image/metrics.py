# SPDX-License-Identifier: Apache-2.0
"""Image metrics that honour masks: PSNR, L1, SSIM, MS-SSIM, LPIPS, as they are and colour-corrected.

Conventions, for every function of this module:

- `pred` and `gt` are images [H, W, 3] in [0, 1] of a floating dtype; `mask` is [H, W, 1] bool, True inside, or None.
- The result is a Python float; None where the metric is undefined (an empty mask, or an image or mask too small for the
  window); NaN only if the prediction is not finite.
- Without a mask the values are those of torchmetrics and pytorch_msssim.
- Under a mask PSNR and L1 are means over the pixels inside. The windowed metrics first replace the prediction outside
  by the truth; SSIM and MS-SSIM average over the windows whose centre is inside; LPIPS, which averages over all pixels,
  is a lower bound.
- Colour-corrected metrics (cc_psnr, cc_ssim, ...) are those of the prediction after `fit_colors`, without the error of
  the test photograph's exposure and white balance, which no method can know. Never quote them alone.
- Arithmetic is float32 on a CPU, float64 if the images are, and on CUDA, where a float32 convolution may run in TF32,
  which is too coarse for SSIM's differences of squares. No gradient is recorded.
"""

from __future__ import annotations

import functools
import os

import torch
import torch.nn.functional as F
from pytorch_msssim import SSIM
from torch import Tensor

METRIC_NAMES = tuple(f"{cc}{name}" for cc in ("", "cc_") for name in ("psnr", "ssim", "ms_ssim", "l1", "lpips"))
"""Keys of `image_metrics`, in the order of reports; cc: colour-corrected."""
WINDOW_SIZE, WINDOW_SIGMA = 11, 1.5
"""Side of the SSIM window and standard deviation of the Gaussian inside, pixels (Wang et al. 2004)."""
REACH = WINDOW_SIZE // 2
"""Pixels from a window's centre to its edge."""
LIBRARY = SSIM(data_range=1.0, size_average=True, channel=3, win_size=WINDOW_SIZE, win_sigma=WINDOW_SIGMA)
"""SSIM of pytorch_msssim, of images [1, 3, H, W]."""
WEIGHTS = tuple(LIBRARY.win[0].flatten().tolist())
"""The window along one axis, rounded to float32 like the library's, which bright flat images feel."""
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""Stabilisers of the luminance and the contrast-structure term, (K * data range)^2."""
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the five scales, finest first (Wang et al. 2003)."""
MS_SSIM_MIN_SIDE = (WINDOW_SIZE - 1) * 2 ** (len(MS_SSIM_WEIGHTS) - 1) + 1
"""Smallest image side with a full window at the coarsest scale: 161 pixels."""
MIN_MSE = 1e-10
"""Floor of the mean squared error, PSNR's cap of 100 dB: JSON and averages cannot hold infinity."""
LPIPS_MIN_SIDE = 31
"""Smallest image side that passes AlexNet's first convolution and pools."""


@torch.no_grad()
def psnr(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> float | None:
    """Peak signal-to-noise ratio in dB for a peak of 1: -10 log10(mean squared error), at most 100."""
    error = _errors_inside(pred, gt, mask)
    return -10.0 * error.square().mean().clamp_min(MIN_MSE).log10().item() if len(error) else None


@torch.no_grad()
def l1(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> float | None:
    """Mean absolute error over pixels and channels, in [0, 1]."""
    error = _errors_inside(pred, gt, mask)
    return error.abs().mean().item() if len(error) else None


@torch.no_grad()
def ssim(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> float | None:
    """Structural similarity (Wang et al. 2004), mean over channels and valid windows; 1 is identical."""
    pred, gt, mask = _planes(pred, gt, mask)
    if min(gt.shape[-2:]) < WINDOW_SIZE:
        return None
    per_channel = _mean_over_centres(ssim_maps(pred, gt)[0], mask)
    return None if per_channel is None else per_channel.mean().item()


@torch.no_grad()
def ms_ssim(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> float | None:
    """Multi-scale SSIM (Wang et al. 2003) over five scales: prod_j cs_j^w_j, times ssim^w at the coarsest scale.

    Each channel's means are clamped at zero before the powers, and the product is averaged over the channels. Scales
    are averages over 2 x 2 pixels; a coarse pixel is inside the mask if any of its fine pixels is. None if a side is
    shorter than 161 pixels, or if at some scale no window has its centre inside the mask.
    """
    pred, gt, mask = _planes(pred, gt, mask)
    if min(gt.shape[-2:]) < MS_SSIM_MIN_SIDE:
        return None
    product = torch.ones(3, dtype=gt.dtype, device=gt.device)
    for scale, weight in enumerate(MS_SSIM_WEIGHTS, start=1):
        ssim_map, cs_map = ssim_maps(pred, gt)
        coarsest = scale == len(MS_SSIM_WEIGHTS)
        per_channel = _mean_over_centres(ssim_map if coarsest else cs_map, mask)
        if per_channel is None:
            return None
        product = product * per_channel.relu() ** weight
        # Odd sides are padded with one zero at either end, as in pytorch_msssim.
        padding = [side % 2 for side in gt.shape[-2:]]
        pred, gt = (F.avg_pool2d(image[None], 2, padding=padding)[0] for image in (pred, gt))
        mask = None if mask is None else F.max_pool2d(mask[None].float(), 2, padding=padding)[0] > 0
    return product.mean().item()


def ssim_maps(pred: Tensor, gt: Tensor) -> tuple[Tensor, Tensor]:
    """The SSIM map and its contrast-structure factor of images [3, H, W], sides of at least 11.

    With the moments mu, var, cov under an 11 x 11 Gaussian of sigma 1.5:
    cs = (2 cov + C2) / (var_p + var_g + C2), ssim = cs (2 mu_p mu_g + C1) / (mu_p^2 + mu_g^2 + C1).

    Returns:
        ssim and cs, [3, H - 10, W - 10] each; entry (i, j) is the window centred on pixel (i + 5, j + 5).
    """
    taps = torch.arange(WINDOW_SIZE, dtype=gt.dtype, device=gt.device) - REACH
    gauss = torch.exp(-taps.square() / (2 * WINDOW_SIGMA**2))
    gauss = gauss / gauss.sum()
    mu_p, mu_g, square_p, square_g, cross = blur(torch.cat([pred, gt, pred * pred, gt * gt, pred * gt]), gauss).split(3)
    cs_map = (2 * (cross - mu_p * mu_g) + SSIM_C2) / (square_p - mu_p**2 + square_g - mu_g**2 + SSIM_C2)
    ssim_map = cs_map * (2 * mu_p * mu_g + SSIM_C1) / (mu_p**2 + mu_g**2 + SSIM_C1)
    return ssim_map, cs_map


def blur(planes: Tensor, window: Tensor) -> Tensor:
    """Weighted means over all whole windows, the same window [11] on either axis: [P, H, W] -> [P, H - 10, W - 10]."""
    for shape in ((-1, 1), (1, -1)):
        planes = F.conv2d(planes, window.view(1, 1, *shape).expand(len(planes), -1, -1, -1), groups=len(planes))
    return planes


def image_metrics(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> dict[str, float | None]:
    """The metrics of an image by `METRIC_NAMES`, on the device of `pred`.

    LPIPS (Zhang et al. 2018, AlexNet) uses torchvision's backbone weights if they are on disk and never downloads them:
    without them it is None, and `lpips_advice` says how to get them.
    """
    gt = gt.to(pred.device)
    mask = None if mask is None else mask.to(pred.device)
    images = pred, fit_colors(pred, gt, mask)
    values = (metric(image, gt, mask) for image in images for metric in (psnr, ssim, ms_ssim, l1, _lpips))
    return dict(zip(METRIC_NAMES, values, strict=True))


@torch.no_grad()
def fit_colors(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> Tensor:
    """The prediction after the affine map of colours nearest to the truth (least squares inside the mask), clamped to
    [0, 1]. A prediction that is not finite, or has nothing inside, stays as it is."""
    colors = torch.cat([pred.double(), torch.ones_like(pred[..., :1], dtype=torch.float64)], dim=-1)
    inside, target = (
        image.reshape(-1, image.shape[-1]) if mask is None else image[mask[..., 0]] for image in (colors, gt.double())
    )
    if len(inside) == 0 or not torch.isfinite(inside).all():
        return pred
    # The pseudo-inverse: an image of one colour determines fewer than 12 numbers.
    affine = torch.linalg.pinv(inside.T @ inside, hermitian=True) @ (inside.T @ target)
    return (colors @ affine).clamp(0.0, 1.0).to(pred.dtype)


@torch.no_grad()
def _lpips(pred: Tensor, gt: Tensor, mask: Tensor | None) -> float | None:
    net = _lpips_net()
    pred, gt, mask = _planes(pred, gt, mask)
    if isinstance(net, str) or min(gt.shape[-2:]) < LPIPS_MIN_SIDE or (mask is not None and not mask.any()):
        return None
    # The network was trained on images in range; a rasterizer can overshoot.
    pred, gt = (image.clamp(0.0, 1.0).float()[None] for image in (pred, gt))
    return net.to(gt.device)(pred, gt, normalize=True).item()


@functools.cache
def _lpips_net() -> torch.nn.Module | str:
    """Torchmetrics' LPIPS network if its AlexNet weights are on disk, else how to get them."""
    from torchvision.models import AlexNet_Weights

    url = AlexNet_Weights.DEFAULT.url
    path = os.path.join(torch.hub.get_dir(), "checkpoints", os.path.basename(url))
    problem = f"{path} is missing"
    if os.path.isfile(path):
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity  # takes seconds

        try:
            # The bare network: the metric around it would keep every score it ever gave.
            return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).net
        except Exception as error:  # whatever a damaged file leads to
            problem = f"{path} cannot be loaded ({type(error).__name__}): delete it"
    return (
        f"LPIPS is not reported: {problem}. To get it, run this on a connected machine, and copy the file here:\n"
        f'  python -c "import torch; torch.hub.load_state_dict_from_url({url!r})"'
    )


def lpips_advice() -> str | None:
    """Why LPIPS is not reported, and how to get it; None if it is."""
    net = _lpips_net()
    return net if isinstance(net, str) else None


def _precise(image: Tensor) -> Tensor:
    return image.to(torch.promote_types(image.dtype, torch.float64 if image.is_cuda else torch.float32))


def _errors_inside(pred: Tensor, gt: Tensor, mask: Tensor | None) -> Tensor:
    """Errors of the N pixels inside, [N, 3]."""
    error = _precise(pred) - _precise(gt)
    return error.reshape(-1, 3) if mask is None else error[mask[..., 0]]


def _planes(pred: Tensor, gt: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Images channel-first [3, H, W] and the mask [H, W]; outside, the truth replaces the prediction."""
    pred, gt = (_precise(image).movedim(-1, 0).contiguous() for image in (pred, gt))
    if mask is None:
        return pred, gt, None
    inside = mask[..., 0]
    return torch.where(inside, pred, gt), gt, inside


def _mean_over_centres(maps: Tensor, mask: Tensor | None) -> Tensor | None:
    """Mean per channel [3] of maps [3, H - 10, W - 10] over windows centred inside mask [H, W]; None without any."""
    if mask is None:
        return maps.mean((-2, -1))
    inside = maps[:, mask[REACH:-REACH, REACH:-REACH]]
    return inside.mean(-1) if inside.shape[-1] else None
