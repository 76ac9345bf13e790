# SPDX-License-Identifier: Apache-2.0
"""The CPU back end: `projection`, `tiles`, `compositing`, in this order. Their float64 twin lives with the tests."""

from __future__ import annotations

from torch import Tensor

from ..contract import Projection
from . import compositing
from .projection import project

__all__ = ["composite", "leaves_out", "project"]


def leaves_out(projection: Projection, colors: Tensor, opacities: Tensor) -> bool:
    """Whether `composite` can leave out rows that are not finite."""
    return False


def composite(
    projection: Projection,
    colors: Tensor,
    opacities: Tensor,
    backgrounds: Tensor | None,
    absgrad: bool,
    leave_out: bool,
) -> tuple[Tensor, Tensor, dict]:
    """Render [C, H, W, D] over backgrounds [C, D], alphas [C, H, W, 1], and no lists to add to `info`."""
    render, transmittance = compositing.composite(projection, colors, opacities, absgrad)
    if backgrounds is not None:
        render = render + transmittance * backgrounds[:, None, None, :]
    return render, 1 - transmittance, {}
