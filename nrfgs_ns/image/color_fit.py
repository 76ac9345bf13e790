# SPDX-License-Identifier: Apache-2.0
"""The fit behind the colour-corrected metrics: what a rendering is worth apart from exposure and white balance."""

import torch
from torch import Tensor


@torch.no_grad()
def fit_colors(pred: Tensor, gt: Tensor, mask: Tensor | None = None) -> Tensor:
    """The affine map of colours that takes a prediction nearest to the truth, applied to it.

    Least squares over the pixels inside the mask: 12 numbers for an image, the same for all of its pixels.

    Args:
        pred, gt: [H, W, 3] in [0, 1].
        mask: [H, W, 1] bool, True inside; None: everywhere.

    Returns:
        [H, W, 3] in [0, 1]. A prediction that is not finite, or has nothing inside the mask, comes back as it is.
    """
    colors = torch.cat([pred.double(), torch.ones_like(pred[..., :1], dtype=torch.float64)], dim=-1)
    inside, wanted = (
        image.reshape(-1, image.shape[-1]) if mask is None else image[mask[..., 0]] for image in (colors, gt.double())
    )
    if len(inside) == 0 or not torch.isfinite(inside).all():
        return pred
    # The pseudo-inverse: an image of one colour determines fewer than 12 numbers.
    affine = torch.linalg.pinv(inside.T @ inside, hermitian=True) @ (inside.T @ wanted)
    return (colors @ affine).clamp(0.0, 1.0).to(pred.dtype)
