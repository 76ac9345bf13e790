# SPDX-License-Identifier: Apache-2.0
r"""Residuals that training views do not show, and components of the latents, left out of a field.

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

from nrfgs_ns.appearance.field import DIFFUSE, Field
from nrfgs_ns.appearance.head import SH_C0, SplatAppearance
from nrfgs_ns.appearance.reduce import latent_basis, with_rank
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model.harmonics_fit import OPAQUE, look_through

EIGHT_BIT_STEP = 1.0 / 255.0
THRESHOLDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, float("inf"))
"""Largest changes below which residuals are dropped, in 8-bit steps."""
SHARE_FOR_RESIDUALS = 0.5
"""Share of the allowed loss for dropped residuals; the rest is for the latents' rank."""


class Residuals(NamedTuple):
    """N splats' residuals over the training views."""

    weight: Tensor
    """alpha T summed over pixels and views; 0 for an unseen splat. [N]"""
    largest: Tensor
    """largest change over the views, in 8-bit steps; 0 for an unseen splat. [N]"""
    features_dc: Tensor
    """the mean colour y as the constant harmonic's coefficients; the base's for an unseen splat. [N, 3]"""
    opacities: Tensor
    """the mean opacity a as a logit, likewise. [N, 1]"""


@torch.no_grad()
def look_over(model, cameras: Cameras) -> Residuals:
    """Measure every splat of a model in evaluation mode from all training views; diffuse splats change by 0."""
    count, device = model.num_points, model.device
    sums = torch.zeros(count, 5, dtype=torch.float64, device=device)  # w, w y, w a
    for rows, share, (colors, opacities) in _views_of(model, cameras):
        columns = torch.cat([torch.ones_like(opacities)[:, None], colors, opacities[:, None]], dim=-1)
        sums.index_add_(0, rows, (share[:, None] * columns).double())
    weight = sums[:, 0]
    mean = (sums[:, 1:] / weight.clamp_min(torch.finfo(torch.float64).tiny)[:, None]).float()
    largest = torch.zeros(count, device=device)
    for rows, share, (colors, opacities) in _views_of(model, cameras):
        change = torch.minimum(opacities, share) * (colors - mean[rows, :3]).abs().amax(dim=-1)
        light = (share / opacities.clamp_min(1e-10)).clamp_max(1.0)
        change = change + light * (opacities - mean[rows, 3]).abs()
        largest.scatter_reduce_(0, rows, change / EIGHT_BIT_STEP, "amax")
    unseen = (weight == 0)[:, None]
    logits = torch.logit(mean[:, 3:].clamp(1.0 - OPAQUE, OPAQUE))
    return Residuals(
        weight=weight.float(),
        largest=largest,
        features_dc=torch.where(unseen, model.gauss_params["features_dc"], (mean[:, :3] - 0.5) / SH_C0),
        opacities=torch.where(unseen, model.gauss_params["opacities"], logits),
    )


def _views_of(model, cameras: Cameras) -> Iterator[tuple[Tensor, Tensor, SplatAppearance]]:
    """Each view's visible rows [M], their contributions w [M], and their appearance."""
    for index in range(len(cameras)):
        view, appearance, share = look_through(model, model.field, cameras[index : index + 1])
        yield view.visible, share.clamp_min(0.0), appearance


class FieldViews:
    """Views with their photographs, projected once: slimming moves no splats.

    Args:
        model: in evaluation mode.
        views: pairs of a camera and its batch; at least one.
    """

    def __init__(self, model, views: list):
        self.model, self.views = model, []
        for camera, batch in views:
            with torch.no_grad():
                view = model.project(camera.to(model.device))
            truth = model.truth_of(batch, model.background_color.to(model.device))
            self.views.append((view, truth, model.mask_of(batch)))

    @torch.no_grad()
    def psnr(self, field: Field) -> float:
        """Mean over the views, inside masks, dB; views whose mask is empty are left out."""
        scores = []
        for view, truth, mask in self.views:
            outputs, _ = self.model.composite(view, field.seen_from(view))
            scores.append(psnr(outputs["rgb"], truth, mask))
        scores = [score for score in scores if score is not None]
        return sum(scores) / max(len(scores), 1)


def with_diffuse(field: Field, diffuse: Tensor, features_dc: Tensor, opacities: Tensor) -> Field:
    """The splats `diffuse`, bool [N], without residual, and their appearance instead: [N, 3] and logits [N, 1]."""
    splats = {**field.splats, DIFFUSE: diffuse}
    for name, value in (("features_dc", features_dc), ("opacities", opacities)):
        splats[name] = torch.where(diffuse[:, None], value, field.splats[name].detach())
    return Field(field.head, splats)


def dropped(field: Field, seen: Residuals, threshold: float) -> Field:
    """The field with splats whose largest change is below `threshold` 8-bit steps made diffuse, at their mean."""
    return with_diffuse(field, seen.largest < threshold, seen.features_dc, seen.opacities)


def slim(field: Field, seen: Residuals, views: FieldViews, lowest_psnr: float) -> tuple[Field, float, int]:
    """The smallest field that keeps a PSNR on the views, dB: first the largest of THRESHOLDS within its share of the
    allowed loss, then the lowest rank for the other splats; that threshold, 0 for none, and the rank."""
    enough = lowest_psnr + (1 - SHARE_FOR_RESIDUALS) * (views.psnr(field) - lowest_psnr)
    threshold = 0.0
    for candidate in reversed(THRESHOLDS):
        smaller = dropped(field, seen, candidate)
        if views.psnr(smaller) >= enough:
            field, threshold = smaller, candidate
            break
    basis = latent_basis(field, seen.weight)
    low, rank = 1, field.head.config.latent_dim
    while low < rank:  # the loss falls with the rank, except for rounding: halve the interval
        middle = (low + rank) // 2
        enough = views.psnr(with_rank(field, basis, middle)) >= lowest_psnr
        low, rank = (low, middle) if enough else (middle + 1, rank)
    whole = rank == field.head.config.latent_dim
    return field if whole else with_rank(field, basis, rank), threshold, rank
