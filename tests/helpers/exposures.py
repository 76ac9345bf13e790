# SPDX-License-Identifier: Apache-2.0
"""Images exposed as the model of a photograph says, without the model."""

import torch
from torch import Tensor

from nrfgs_ns.image.photograph import GAMMA, TOE


def exposed(image: Tensor, stops: float | Tensor) -> Tensor:
    """An image [H, W, 3] with more stops of light, one number or one for each channel [3]; clamped to [0, 1]."""
    gain = torch.exp2(torch.as_tensor(stops, dtype=image.dtype, device=image.device) / GAMMA)
    return (gain * (image + TOE) - TOE).clamp(0.0, 1.0)
