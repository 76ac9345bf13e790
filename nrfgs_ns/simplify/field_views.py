# SPDX-License-Identifier: Apache-2.0
"""How good a field is on some views, and how small it can be made within a loss."""

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter, process_time
from typing import NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.reduce import LatentBasis, latent_basis, with_diffuse, with_rank
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.simplify.residuals import Residuals

THRESHOLDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, float("inf"))
"""Largest changes below which residuals are dropped, in 8-bit steps."""
SHARE_FOR_RESIDUALS = 0.5
"""Of the loss that is allowed: what dropping residuals may take. The latents' rank may take what is left."""
TIMED = 5
"""Times that a view's head is evaluated; the fastest counts, because other work on the machine only ever adds."""


class FieldViews:
    """Views with their photographs, projected once: what is left out of a field does not move splats.

    Args:
        model: an NrfgsModel in evaluation mode.
        views: pairs of a camera and its batch; at least one.
        photographs: which of the photographs that the model has learnt each view is, so that its look is not counted as
            an error; None: the mean look.
    """

    def __init__(self, model, views: list, photographs: Sequence[int | None] | None = None):
        self.model = model
        self.views = []
        self.photographs = [None] * len(views) if photographs is None else list(photographs)
        for camera, batch in views:
            with torch.no_grad():
                view = model.project(camera.to(model.device))
            truth = model.truth_of(batch, model.background_color.to(model.device))
            self.views.append((view, truth, model.mask_of(batch)))

    def psnr(self, field: Field) -> float:
        """Mean over the views, inside masks, dB."""
        scores = self.scores(field)
        return sum(scores) / max(len(scores), 1)

    @torch.no_grad()
    def scores(self, field: Field) -> list[float]:
        """PSNR of each view inside its mask, dB; views whose mask is empty are left out."""
        scores = []
        for (view, truth, mask), photograph in zip(self.views, self.photographs, strict=True):
            outputs, _ = self.model.composite(view, field.seen_from(view), photograph=photograph)
            score = psnr(outputs["rgb"], truth, mask)
            scores += [] if score is None else [score]
        return scores

    @torch.no_grad()
    def head_seconds(self, field: Field) -> float:
        """Mean over the views of what the head takes for one; diffuse splats last, as in a training and in a file."""
        seconds = []
        for view, _, _ in self.views:
            rows = diffuse_last(field.splats, view.visible)
            seconds.append(fastest(lambda rows=rows, center=view.center: field.head(field.splats, rows, center)))
        return sum(seconds) / len(seconds)


def diffuse_last(splats: Mapping[str, Tensor], visible: Tensor) -> Tensor:
    """The visible rows, those of diffuse splats behind the others."""
    if DIFFUSE not in splats:
        return visible
    return visible[splats[DIFFUSE][visible].to(torch.uint8).argsort(stable=True)]


def fastest(work: Callable[[], object]) -> float:
    """Seconds of the fastest of some runs: wall-clock on a GPU; on a CPU processor time, which other programs that
    share the machine do not enter."""
    clock = perf_counter if torch.cuda.is_available() else process_time
    times = []
    for _ in range(TIMED):
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        start = clock()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(clock() - start)
    return min(times)


def dropped(field: Field, seen: Residuals, threshold: float) -> Field:
    """Splats whose largest change is below `threshold` 8-bit steps look from everywhere as they do on average."""
    return with_diffuse(field, seen.negligible(threshold), seen.features_dc, seen.opacities)


def largest_threshold(
    field: Field,
    seen: Residuals,
    views: FieldViews,
    lowest_psnr: float,
    on_trial: Callable[[str], None] = lambda _: None,
) -> float:
    """The largest of THRESHOLDS below which residuals can be dropped while the views keep a PSNR (dB); 0 for none."""
    for candidate in reversed(THRESHOLDS):
        on_trial(f"residuals below {candidate:g} steps")
        if views.psnr(dropped(field, seen, candidate)) >= lowest_psnr:
            return candidate
    return 0.0


def smallest_rank(
    field: Field,
    basis: LatentBasis,
    views: FieldViews,
    lowest_psnr: float,
    on_trial: Callable[[str], None] = lambda _: None,
) -> int:
    """The fewest principal components of the latents with which the views keep a PSNR (dB); D if none are enough."""
    low, rank = 1, field.head.config.latent_dim
    while low < rank:  # the loss falls with the rank, but for rounding: halve the interval
        middle = (low + rank) // 2
        on_trial(f"latent rank {middle}")
        enough = views.psnr(with_rank(field, basis, middle)) >= lowest_psnr
        low, rank = (low, middle) if enough else (middle + 1, rank)
    return rank


class Slimmed(NamedTuple):
    """A field that is smaller, and by what."""

    field: Field
    threshold: float
    """residuals below so many 8-bit steps are dropped; 0 for none"""
    rank: int
    """numbers in a latent"""


def slim(
    field: Field,
    seen: Residuals,
    views: FieldViews,
    lowest_psnr: float,
    threshold: float | None = None,
    rank: int | None = None,
    on_trial: Callable[[str], None] = lambda _: None,
) -> Slimmed:
    """The smallest field, of those that drop residuals and components of the latents, that still has a PSNR.

    First the largest of THRESHOLDS that costs no more than its share of what may be lost, then the lowest rank for the
    splats that are left.

    Args:
        lowest_psnr: on the views, dB.
        threshold, rank: not to be looked for.
    """
    if threshold is None:
        spare = views.psnr(field) - lowest_psnr
        threshold = largest_threshold(field, seen, views, lowest_psnr + (1 - SHARE_FOR_RESIDUALS) * spare, on_trial)
    if threshold > 0:
        field = dropped(field, seen, threshold)
    basis = latent_basis(field, seen.weight)
    size = field.head.config.latent_dim
    if rank is None:
        rank = smallest_rank(field, basis, views, lowest_psnr, on_trial)
    return Slimmed(with_rank(field, basis, rank) if rank < size else field, threshold, rank)
