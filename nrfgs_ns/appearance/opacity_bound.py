# SPDX-License-Identifier: Apache-2.0
"""How a view-dependent opacity is kept in [0, 1]: four ways to add a residual t = tanh(d_alpha) to a base opacity.

With base opacity alpha = sigmoid(logit) and x = alpha + s t:

    clamp             opacity = min(max(x, 0), 1)                 no gradient beyond the ends
    straight-through  the same, but the gradient is that of x      a splat beyond an end can come back
    logit             opacity = sigmoid(logit + 4 s t)             sigmoid's slope at half opacity is 1/4: there, to
                                                                   first order, the same as alpha + s t
    smooth            opacity = (softplus(B x) - softplus(B (x - 1))) / B     a clamp with corners about 1 / B wide

Where MCMC puts n copies in a splat's place, each of about alpha / n, s t would be added n times; on the logit it scales
with the opacity, and the copies together show about what the one did.

The last differs from alpha by at most log(2) / B where t = 0; the others do not.
"""

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import softplus

OpacityBound = Literal["clamp", "straight-through", "logit", "smooth"]
OPACITY_BOUNDS: tuple[OpacityBound, ...] = ("clamp", "straight-through", "logit", "smooth")

SHARPNESS = 50.0
"""B of the smooth clamp: its corners are as wide as a tenth of the default residual."""
LOGIT_SLOPE = 4.0
"""One over the sigmoid's slope at half opacity."""


def bounded_opacity(logit: Tensor, residual: Tensor, scale: float, bound: OpacityBound) -> Tensor:
    """Opacity with its residual.

    Args:
        logit: base opacities' logits, [M, 1].
        residual: t, [M, 1], in [-1, 1].
        scale: s >= 0, the largest change of opacity (for "logit": at half opacity and to first order).
        bound: one of OPACITY_BOUNDS.

    Returns:
        [M, 1], in [0, 1].
    """
    if bound == "logit":
        return torch.sigmoid(logit + LOGIT_SLOPE * scale * residual)
    x = torch.sigmoid(logit) + scale * residual
    if bound == "smooth":
        return softplus(x, beta=SHARPNESS) - softplus(x - 1.0, beta=SHARPNESS)
    clamped = x.clamp(0.0, 1.0)
    return clamped if bound == "clamp" else x + (clamped - x).detach()
