# SPDX-License-Identifier: Apache-2.0
"""Trimming: pixels that show something other than the scene, such as passers-by, lose their weight.

The statistics of SpotLessSplats (Sabour et al., arXiv 2406.20055), without its features: a pixel is trimmed if its
residual is among the largest of recent photographs, unless most pixels around it are not. The photographs share one
threshold: much is trimmed where much has moved. To let the scene be learnt, only residuals far above the median count,
what moved must be large (a pixel is kept where many in a patch around it are, as in RobustNeRF, arXiv 2302.00833), and
trimmed pixels lose their weight gradually.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BINS = 1000
"""Bins of the histogram of residuals in [0, 1]."""
MEMORY = 0.95
"""Weight of older photographs in the histogram when the next one comes."""
USUAL = 5.0
"""Least residual of a trimmed pixel, in median residuals."""
WINDOW = 3
"""Side of the square around a pixel, in pixels."""
PATCH, MOST_KEPT = 0.04, 0.6
"""Side of the patch around a pixel, in longer sides of the image; share of it above which the pixel is kept."""
FIRST_STEP = 500
"""First step at which pixels are trimmed."""
FADE_STEPS = 1500
"""Steps in which trimmed pixels lose their weight from then on."""


class Trimming(nn.Module):
    """A memory of residuals by which the largest are trimmed: at most a `share` of the pixels, in (0, 1)."""

    def __init__(self, share: float):
        super().__init__()
        self.share = share
        self.register_buffer("histogram", torch.zeros(BINS))

    def is_on(self, step: int) -> bool:
        """Whether pixels are trimmed at a step of the schedule."""
        return step >= FIRST_STEP

    def fades_at(self, step: int) -> bool:
        """Whether weights depend on the step."""
        return FIRST_STEP <= step < FIRST_STEP + FADE_STEPS

    @torch.no_grad()
    def forward(self, prediction: Tensor, truth: Tensor, step: int, mask: Tensor | None = None) -> Tensor:
        """Weights [H, W, 1] of the pixels of images [H, W, 3] in [0, 1]; 1.0 is kept. Nothing waits for a GPU.

        `step` of the schedule is `FIRST_STEP` or later; pixels outside `mask` [H, W, 1] are not remembered.
        """
        error = (prediction - truth).abs().mean(dim=-1)
        counted = error if mask is None else torch.where(mask[..., 0] >= 0.5, error, -1.0)  # beyond the bins
        self.histogram.mul_(MEMORY).add_(torch.histc(counted, BINS, 0.0, 1.0))
        threshold = torch.maximum(self._quantile(1.0 - self.share), USUAL * self._quantile(0.5))
        kept = (error <= threshold).to(prediction.dtype)
        kept = torch.maximum(kept, (_mean_around(kept, WINDOW) > 0.5).to(kept.dtype))
        patch = 2 * round(PATCH * max(error.shape) / 2) + 1
        kept = torch.maximum(kept, (_mean_around(kept, patch) > MOST_KEPT).to(kept.dtype))[..., None]
        weight_of_trimmed = max(1.0 - (step - FIRST_STEP) / FADE_STEPS, 0.0)
        return kept.clamp_min(weight_of_trimmed)

    def _quantile(self, share: float) -> Tensor:
        """The residual below which this share of those remembered lies, a scalar."""
        reached = self.histogram.cumsum(0) >= share * self.histogram.sum()
        return (BINS - reached.sum() + 1) / BINS


def _mean_around(values: Tensor, side: int) -> Tensor:
    """Mean over a square around each pixel, [H, W]."""
    return F.avg_pool2d(values[None], side, stride=1, padding=side // 2, count_include_pad=False)[0]
