# SPDX-License-Identifier: Apache-2.0
r"""What the training views see of a splat's residual: what decides whether a splat needs one.

A residual has a part that all views see, which the base colour can hold as well, and the rest. Seen in training view v
with colour y_v and opacity a_v, and contributing w_v (alpha T, summed over the view's pixels) to the picture, splat i
looks from everywhere like

    y = sum_v w_v y_v / sum_v w_v,    a = sum_v w_v a_v / sum_v w_v

if it must have one appearance. Giving it that changes a pixel of view v by no more than

    change_v = min(a_v, w_v) |y_v - y|_max + min(1, w_v / a_v) |a_v - a|.

The first factor bounds alpha T in any one pixel, because none of the sum's terms is negative and alpha is at most the
opacity; the second bounds the light that reaches the splat, with the contrast of the splat against what is behind it
at its largest, 1. A splat's largest change over the views is measured in steps between two 8-bit values: half a step
cannot, by itself, turn a pixel's byte by more than rounding does.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from nrfgs_ns.appearance.head import SH_C0, SplatAppearance
from nrfgs_ns.model.harmonics_fit import OPAQUE, look_through

EIGHT_BIT_STEP = 1.0 / 255.0


class Residuals(NamedTuple):
    """What the training views say of N splats, and of the distances from which they are seen."""

    weight: Tensor
    """alpha T summed over pixels and views; 0 for a splat that no view sees. [N]"""
    largest: Tensor
    """largest change over the views, in 8-bit steps; 0 for a splat that no view sees. [N]"""
    features_dc: Tensor
    """the mean colour y as the constant harmonic's coefficients; the base's for a splat that no view sees. [N, 3]"""
    opacities: Tensor
    """the mean opacity a as a logit, likewise. [N, 1]"""
    mean_log_distance: float
    """mean of log r, weighted by contribution; r in scene units, as the field sees it"""

    def negligible(self, threshold: float) -> Tensor:
        """Splats whose largest change is below `threshold` 8-bit steps, bool [N]."""
        return self.largest < threshold


class Sight(NamedTuple):
    """One view of M splats."""

    rows: Tensor
    """of the table, [M]"""
    share: Tensor
    """w of the module's docstring, pixels, [M]"""
    appearance: SplatAppearance
    log_distance: Tensor
    """[M]"""


@torch.no_grad()
def look_over(model, cameras: Cameras) -> Residuals:
    """Look at every splat of a model in evaluation mode from all training views. One that is diffuse already changes by
    nothing.
    """
    count, device = model.num_points, model.device
    sums = torch.zeros(count, 5, dtype=torch.float64, device=device)  # w, w y, w a
    distance = torch.zeros((), dtype=torch.float64, device=device)
    for seen in _sights(model, cameras):
        colors, opacities = seen.appearance
        columns = torch.cat([torch.ones_like(opacities)[:, None], colors, opacities[:, None]], dim=-1)
        sums.index_add_(0, seen.rows, (seen.share[:, None] * columns).double())
        distance += (seen.share * seen.log_distance).double().sum()
    weight = sums[:, 0]
    mean = (sums[:, 1:] / weight.clamp_min(torch.finfo(torch.float64).tiny)[:, None]).float()
    largest = torch.zeros(count, device=device)
    for seen in _sights(model, cameras):
        color, opacity = seen.appearance
        most = torch.minimum(opacity, seen.share)  # of one pixel
        change = most * (color - mean[seen.rows, :3]).abs().amax(dim=-1)
        lit = (seen.share / opacity.clamp_min(1e-10)).clamp_max(1.0)
        change = change + lit * (opacity - mean[seen.rows, 3]).abs()
        largest.scatter_reduce_(0, seen.rows, change / EIGHT_BIT_STEP, "amax")
    unseen = (weight == 0)[:, None]
    logits = torch.logit(mean[:, 3:].clamp(1.0 - OPAQUE, OPAQUE))
    return Residuals(
        weight=weight.float(),
        largest=largest,
        features_dc=torch.where(unseen, model.gauss_params["features_dc"], (mean[:, :3] - 0.5) / SH_C0),
        opacities=torch.where(unseen, model.gauss_params["opacities"], logits),
        mean_log_distance=float(distance / weight.sum().clamp_min(1e-30)),
    )


def _sights(model, cameras: Cameras) -> Iterator[Sight]:
    field = model.field
    for index in range(len(cameras)):
        view, appearance, share = look_through(model, field, cameras[index : index + 1])
        share = share.clamp_min(0.0)
        towards = view.center - field.splats["means"].index_select(0, view.visible)
        log_distance = (towards.norm(dim=-1) / model.head.scene_unit).clamp_min(1e-10).log()
        yield Sight(view.visible, share, appearance, log_distance)
