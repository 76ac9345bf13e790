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
    def forward(self, prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
        """Which pixels to keep, 1.0 or 0.0. Nothing waits for a GPU.

        Args:
            prediction, truth: [H, W, 3] in [0, 1].
            mask: [H, W, 1], what counts; None: everything.

        Returns:
            [H, W, 1].
        """
        error = (prediction - truth).abs().mean(dim=-1)
        counted = error if mask is None else torch.where(mask[..., 0] >= 0.5, error, -1.0)  # beyond the bins
        self.histogram.mul_(MEMORY).add_(torch.histc(counted, BINS, 0.0, 1.0))
        return self.kept(prediction, truth)

    @torch.no_grad()
    def kept(self, prediction: Tensor, truth: Tensor) -> Tensor:
        """As `forward`, by the residuals remembered, without remembering these."""
        error = (prediction - truth).abs().mean(dim=-1)
        reached = self.histogram.cumsum(0) >= (1.0 - self.share) * self.histogram.sum()
        threshold = (BINS - reached.sum() + 1) / BINS
        kept = (error <= threshold).to(prediction.dtype)
        around = F.avg_pool2d(kept[None], WINDOW, stride=1, padding=WINDOW // 2, count_include_pad=False)[0]
        return torch.maximum(kept, (around > 0.5).to(kept.dtype))[..., None]
