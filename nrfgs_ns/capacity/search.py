# SPDX-License-Identifier: Apache-2.0
"""Which parts of a field pay, by views that nothing was trained on.

The whole field settles, and so does each smaller one, on the same views (`settle.py`). Both are then measured on the
views that were set aside. In turn, each on top of what has been dropped before it: the high branch, which is half of
the head; opacity's residual; the distance; and once more what was kept, if something has gone. They may cost half of
the tolerance together. Then the latents keep the fewest principal components that cost no more than the rest. What is
measured is always the whole loss against the whole field, so that small ones do not add up; and where a part did harm,
so that the field is better without it, against that better one, so that latents are not cut at the price of the gain.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from math import sqrt
from typing import Any, NamedTuple

import torch

from nrfgs_ns.appearance.reduce import (
    Field,
    latent_basis,
    with_constant_distance,
    with_rank,
    with_unit_axes,
    without_high_branch,
    without_opacity_residual,
)
from nrfgs_ns.capacity.config import CapacitySearch
from nrfgs_ns.capacity.settle import FIELD, Settled, keep_the_mean, lesson_order, settle
from nrfgs_ns.field_views import FieldViews, smallest_rank
from nrfgs_ns.residuals import Residuals, look_over

SHARE_FOR_PARTS = 0.5
"""Of the tolerance."""
ROUNDS = 2
"""Times that all parts which are left are tried: what did not fit at first may fit when another part, whose absence
does good, is gone."""


@dataclass
class Trial:
    """One field that was tried, on the views set aside."""

    part: str
    """what was dropped on top of what had been dropped before; "nothing" is the whole field"""
    psnr: float
    """after it has settled, dB; latents are cut from a field that has"""
    loss_db: float
    """what that lacks of the whole field; for latents, of the better of that and the field from which they are cut"""
    error_db: float
    """standard error of the loss over the views; 0 for a single view"""
    allowed_db: float
    """largest loss at which it is dropped"""
    psnr_at_once: float
    """before it has settled, dB"""
    bytes: int
    """of the splats and the head, float32"""
    dropped: bool
    """whether it was"""


class Decision(NamedTuple):
    """What a scene needs."""

    chosen: Settled | None
    """the smaller field; None: the whole one stays"""
    trials: list[Trial]
    dropped: list[str]
    """names of what is dropped"""

    @property
    def evidence(self) -> list[dict[str, Any]]:
        return [asdict(trial) for trial in self.trials]


def parts_of(field: Field, seen: Residuals) -> list[tuple[str, Callable[[Field], Field]]]:
    """What can be dropped of a field, and how."""
    parts: list[tuple[str, Callable[[Field], Field]]] = []
    if field.head.high is not None:
        parts.append(("high branch", without_high_branch))
    if field.head.config.opacity_residual:
        parts.append(("opacity residual", without_opacity_residual))
    if field.head.config.use_distance:
        parts.append(("distance", lambda smaller: with_constant_distance(smaller, seen.mean_log_distance)))
    return parts


def decide(model, data, optimizers: Mapping[str, torch.optim.Optimizer], config: CapacitySearch) -> Decision:
    """Find the smallest field that is as good as the whole one.

    Args:
        model: an NrfgsModel with a neural residual field; left as it is.
        data: the datamanager, with views set aside.
        optimizers: the training's, by group.
        config: how.
    """
    was_training = model.training
    model.eval()
    aside = FieldViews(model, [data.train_view(index) for index in data.views_aside], geometry=True)
    lessons = [data.train_view(index) for index in lesson_order(data, config.settle)]
    cameras = data.train_dataset.cameras
    seen = look_over(model, cameras)  # where cameras are, not what is on their photographs
    field = Field(model.head, {name: value.detach() for name, value in model._splats_to_draw().items()})

    def settled(smaller: Field) -> Settled:
        return settle(model, smaller, lessons, config.settle, optimizers, FIELD)

    whole = settled(field)
    reference = aside.scores(whole.field)
    trials = [_trial("nothing", field, whole.field, aside, reference, 0.0)]

    # Each part is taken from the field as it was trained: what is kept has not settled twice.
    chosen, kept, dropped = whole, field, []
    allowed = SHARE_FOR_PARTS * config.tolerance_db
    for _ in range(ROUNDS):
        before = len(dropped)
        for part, without in parts_of(kept, seen):
            smaller = keep_the_mean(model, kept, without(kept), lessons)
            candidate = settled(smaller)
            trials.append(_trial(part, smaller, candidate.field, aside, reference, allowed))
            if trials[-1].loss_db <= allowed:
                trials[-1].dropped = True
                chosen, kept = candidate, smaller
                dropped.append(part)
        if len(dropped) == before:
            break

    basis = with_unit_axes(latent_basis(chosen.field, seen.weight))
    if aside.psnr(chosen.field) > trials[0].psnr:
        reference = aside.scores(chosen.field)
    lowest = sum(reference) / max(len(reference), 1) - config.tolerance_db
    rank = smallest_rank(chosen.field, basis, aside, lowest)
    if rank < field.head.config.latent_dim:
        smaller = with_rank(chosen.field, basis, rank)  # of a field that has settled: measured as it is
        name = f"latents beyond rank {rank}"
        trials.append(_trial(name, smaller, smaller, aside, reference, config.tolerance_db))
        candidate = settled(smaller)  # for Adam's state in the new coordinates
        if trials[-1].loss_db <= config.tolerance_db and aside.psnr(candidate.field) >= lowest:
            trials[-1].dropped = True
            chosen = candidate
            dropped.append(name)
    model.train(was_training)
    return Decision(chosen if dropped else None, trials, dropped)


def _trial(
    part: str, at_once: Field, settled: Field, aside: FieldViews, reference: list[float], allowed: float
) -> Trial:
    scores = aside.scores(settled)
    losses = torch.tensor(reference, dtype=torch.float64) - torch.tensor(scores, dtype=torch.float64)
    error = float(losses.std()) / sqrt(len(losses)) if len(losses) > 1 else 0.0
    return Trial(
        part=part,
        psnr=sum(scores) / max(len(scores), 1),
        loss_db=float(losses.mean()),
        error_db=error,
        allowed_db=allowed,
        psnr_at_once=aside.psnr(at_once),
        bytes=settled.bytes,
        dropped=False,
    )
