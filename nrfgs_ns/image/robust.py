# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a photograph show what the scene does not: passers-by, shadows, whatever moved.

The statistics of SpotLessSplats (Sabour et al., arXiv 2406.20055), without its features: a pixel is trimmed if its
residual is among the largest of the photographs seen lately, unless most pixels around it are not. The photographs
share one threshold, so that much is trimmed of a photograph in which much has moved, and little of one in which
nothing has.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BINS = 1000
"""Of the histogram of residuals in [0, 1]."""
MEMORY = 0.95
"""What is left of a photograph in the histogram when the next one comes."""
WINDOW = 3
"""Side of the square around a pixel, in pixels."""
TIMES, PATCH, FRACTION, FADE = 0.0, 0.0, 0.6, 0
FIRST_STEP = 500
"""Before it nothing is trimmed: a scene that has just begun fits nothing."""


class Trimming(nn.Module):
    """Remembers how large residuals are, and trims the largest.

    Args:
        share: of the pixels that are trimmed, above 0 and below 1, before neighbours are asked.

    Raises:
        ValueError: the share is out of range.
    """

    def __init__(self, share: float):
        super().__init__()
        if not 0.0 < share < 1.0:
            raise ValueError(f"{share} is not above 0 and below 1")
        self.share = share
        self.register_buffer("histogram", torch.zeros(BINS))

    @torch.no_grad()
    def forward(
        self, prediction: Tensor, truth: Tensor, mask: Tensor | None = None, weight_left: float = 0.0
    ) -> Tensor:
        """Which pixels to keep, 1.0, and which to trim, `weight_left`. Nothing waits for a GPU.

        Args:
            prediction, truth: [H, W, 3] in [0, 1].
            mask: [H, W, 1], what counts; None: everything.
            weight_left: of a trimmed pixel, 0 to 1.

        Returns:
            [H, W, 1].
        """
        error = (prediction - truth).abs().mean(dim=-1)
        counted = error if mask is None else torch.where(mask[..., 0] >= 0.5, error, -1.0)  # beyond the bins
        self.histogram.mul_(MEMORY).add_(torch.histc(counted, BINS, 0.0, 1.0))
        return self.kept(prediction, truth, weight_left)

    @torch.no_grad()
    def kept(self, prediction: Tensor, truth: Tensor, weight_left: float = 0.0) -> Tensor:
        """As `forward`, by the residuals remembered, without remembering these."""
        error = (prediction - truth).abs().mean(dim=-1)
        reached = self.histogram.cumsum(0) >= (1.0 - self.share) * self.histogram.sum()
        threshold = (BINS - reached.sum() + 1) / BINS
        if TIMES:
            median = (BINS - (self.histogram.cumsum(0) >= 0.5 * self.histogram.sum()).sum() + 1) / BINS
            threshold = torch.maximum(threshold, TIMES * median)
        kept = (error <= threshold).to(prediction.dtype)
        around = _mean_around(kept, WINDOW)
        kept = torch.maximum(kept, (around > 0.5).to(kept.dtype))
        if PATCH:
            side = 2 * round(PATCH * max(error.shape) / 2) + 1
            kept = torch.maximum(kept, (_mean_around(kept, side) > FRACTION).to(kept.dtype))
        return kept[..., None].clamp_min(weight_left)


def _mean_around(values: Tensor, side: int) -> Tensor:
    """Mean over a square around each pixel, [H, W]."""
    return F.avg_pool2d(values[None], side, stride=1, padding=side // 2, count_include_pad=False)[0]
