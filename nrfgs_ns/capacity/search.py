# SPDX-License-Identifier: Apache-2.0
"""Which parts of a field pay, by views that nothing was trained on.

The whole field settles, and so does each smaller one, on the same views (`settle.py`). Both are then measured on the
views that were set aside. In turn, each on top of what has been dropped before it: the high branch, which is half of
the head; opacity's residual; the distance; and once more what was kept, if something has gone since. They may cost half
of the tolerance together: what is measured is the whole loss against the whole field, so that small ones do not add up.
Then the latents keep the fewest principal components that cost no more than the rest, against the field from which they
are cut: where a part did harm, so that the field is better without it, latents are not cut at the price of the gain.

A field that has grown up with a part is worse at once without it, whether the scene needs the part or not. So both
settle for twice as many steps, and again, while that brings the smaller one nearer; they are compared after as many
steps each. What comes later is given as many steps as those before it took, which its loss contains. The burden of
proof is on the part: it goes unless its worth is above what is allowed by more than one standard error over the views,
the one-standard-error rule of Breiman, Friedman, Olshen and Stone (Classification and Regression Trees, 1984). Few
views cannot tell a small worth from none, and are those to which a field over-fits.
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
from nrfgs_ns.capacity.settle import FIELD, Lessons, Settled, Settling, keep_the_mean
from nrfgs_ns.field_views import FieldViews, smallest_rank
from nrfgs_ns.residuals import Residuals, look_over

SHARE_FOR_PARTS = 0.5
"""Of the tolerance."""
ROUNDS = 2
"""Times that all parts which are left are tried: what did not fit at first may fit when another part, whose absence
does good, is gone."""
CLOSING = 0.25
"""Share of its loss that a round of settling must take off for another to be made."""


@dataclass
class Trial:
    """One field that was tried, on the views set aside."""

    part: str
    """what was dropped on top of what had been dropped before; "nothing" is the whole field"""
    psnr: float
    """after it has settled, dB; latents are cut from a field that has"""
    loss_db: float
    """what that lacks of the whole field after as many steps; for latents, of the field from which they are cut"""
    error_db: float
    """standard error of the loss over the views; 0 for a single view"""
    allowed_db: float
    """what it may cost"""
    limit_db: float
    """largest loss at which it is dropped: what it may cost, and for a part the standard error besides"""
    psnr_at_once: float
    """before it has settled, dB"""
    bytes: int
    """of the splats and the head, float32"""
    dropped: bool
    """whether it was"""
    steps: int
    """in which it has settled; for latents, the field from which they are cut"""
    rounds: list[tuple[int, float, float]]
    """after each round of settling: steps, loss and standard error, dB"""


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


def decide(
    model,
    data,
    optimizers: Mapping[str, torch.optim.Optimizer],
    config: CapacitySearch,
    trying: Callable[[str], None] = lambda what: None,
) -> Decision:
    """Find the smallest field that is as good as the whole one.

    Args:
        model: an NrfgsModel with a neural residual field; left as it is.
        data: the datamanager, with views set aside.
        optimizers: the training's, by group.
        config: how.
        trying: is told what settles next.
    """
    was_training = model.training
    model.eval()
    aside = FieldViews(model, [data.train_view(index) for index in data.views_aside], geometry=True)
    lessons = Lessons(data, config.settle_most)
    cameras = data.train_dataset.cameras
    seen = look_over(model, cameras)  # where cameras are, not what is on their photographs
    field = Field(model.head, {name: value.detach() for name, value in model._splats_to_draw().items()})

    def settling(smaller: Field, steps: int) -> Settling:
        return Settling(model, smaller, lessons, steps, optimizers, FIELD)

    trying("the whole field")
    whole = Whole(settling(field, config.settle), aside)

    # Each part is taken from the field as it was trained: what is kept has not settled twice.
    trials, kept, dropped = [], field, []
    chosen: Settled | None = None
    gone_when_tried: dict[str, int] = {}
    lost = 0.0
    allowed = SHARE_FOR_PARTS * config.tolerance_db
    for _ in range(ROUNDS):
        before = len(dropped)
        for part, without in parts_of(kept, seen):
            if gone_when_tried.get(part) == len(dropped):
                continue  # the same field has been tried
            gone_when_tried[part] = len(dropped)
            trying(f"the field without its {part}")
            smaller = keep_the_mean(model, kept, without(kept), lessons)
            learning, least = settling(smaller, config.settle), 0 if chosen is None else chosen.steps
            trial, candidate = try_without(part, smaller, learning, whole, aside, allowed, config.settle_most, least)
            del learning  # a trial's copies go before those of the next are made
            trials.append(trial)
            if candidate is not None:
                chosen, kept, lost = candidate, smaller, trial.loss_db
                dropped.append(part)
            del candidate
        if len(dropped) == before:
            break

    chosen = whole.settled if chosen is None else chosen
    trials.insert(0, whole.trial(field))
    del whole  # nothing is measured against it any more
    trying("latents of fewer numbers")
    reference, steps = aside.scores(chosen.field), chosen.steps
    basis = with_unit_axes(latent_basis(chosen.field, seen.weight))
    # Within the tolerance as it stands, without a standard error: ranks are many, of which the luckiest would be found,
    # and all are cut from the same settled field, so that there is no chance of two trainings between neighbours.
    rest = rest_for_latents(config.tolerance_db, lost)
    lowest = mean(reference) - rest
    rank = smallest_rank(chosen.field, basis, aside, lowest)
    if rank < field.head.config.latent_dim:
        smaller = with_rank(chosen.field, basis, rank)  # of a field that has settled: measured as it is
        scores = aside.scores(smaller)
        loss, error = loss_of(scores, reference)
        psnr, rounds = mean(scores), [(steps, loss, error)]
        name = f"latents beyond rank {rank}"
        trial = Trial(name, psnr, loss, error, rest, rest, psnr, smaller.bytes, False, steps, rounds)
        trials.append(trial)
        candidate = settling(smaller, steps).advance()  # for Adam's state in the new coordinates
        if loss <= rest and aside.psnr(candidate.field) >= lowest:
            trial.dropped = True
            chosen = candidate
            dropped.append(name)
    model.train(was_training)
    return Decision(chosen if dropped else None, trials, dropped)


def rest_for_latents(tolerance_db: float, lost: float) -> float:
    """What latents may cost, dB.

    Args:
        tolerance_db: what everything may.
        lost: by parts that are dropped. What is above their share is within its standard error and counts for nothing;
            so does a gain.
    """
    return tolerance_db - min(max(lost, 0.0), SHARE_FOR_PARTS * tolerance_db)


class Whole:
    """The whole field as it settles: what smaller ones are measured against. A round is made when it is asked for.

    Args:
        settling: the field's.
        aside: the views that it is measured on.
    """

    def __init__(self, settling: Settling, aside: FieldViews):
        self.settling, self.aside = settling, aside
        self._rounds: dict[int, list[float]] = {}
        self._next()

    def _next(self) -> None:
        self.settled = None  # before there is another
        self.settled = self.settling.advance()
        self._rounds[self.settled.steps] = self.aside.scores(self.settled.field)

    def scores(self, steps: int) -> list[float]:
        """PSNR of each view after so many steps, dB.

        Args:
            steps: those of a round.
        """
        while max(self._rounds) < steps:
            self._next()
        return self._rounds[steps]

    def trial(self, field: Field) -> Trial:
        """What there is to say of it after its last round.

        Args:
            field: before it has settled.
        """
        last, at_once = self.settled.steps, self.aside.psnr(field)
        rounds = [(steps, 0.0, 0.0) for steps in self._rounds]
        return Trial("nothing", mean(self._rounds[last]), 0.0, 0.0, 0.0, 0.0, at_once, field.bytes, False, last, rounds)


def try_without(
    part: str,
    smaller: Field,
    settling: Settling,
    whole: Whole,
    aside: FieldViews,
    allowed: float,
    most: int,
    least: int = 0,
) -> tuple[Trial, Settled | None]:
    """Let a smaller field settle until it may take the place of the whole one, or does not come nearer.

    Args:
        part: what it is without.
        smaller: before it has settled.
        settling: its settling, before the first round.
        whole: what it is measured against after each round.
        aside: views that it is measured on.
        allowed: what it may cost, dB, besides the standard error.
        most: steps of settling.
        least: steps of settling before it is given up: as many as it took for what has gone before it, which its loss
            contains.

    Returns:
        The evidence, and the field after its last round; None if it does not take the place.
    """
    rounds: list[tuple[int, float, float]] = []
    while True:
        candidate = settling.advance()
        scores = aside.scores(candidate.field)
        loss, error = loss_of(scores, whole.scores(candidate.steps))
        rounds.append((candidate.steps, loss, error))
        limit = allowed + error
        may_go = loss <= limit
        closing = len(rounds) == 1 or candidate.steps < least or loss <= (1.0 - CLOSING) * rounds[-2][1]
        if may_go or not closing or 2 * candidate.steps > most:
            break
        del candidate  # before there is another
    psnr, at_once, steps = mean(scores), aside.psnr(smaller), candidate.steps
    trial = Trial(part, psnr, loss, error, allowed, limit, at_once, smaller.bytes, may_go, steps, rounds)
    return trial, candidate if may_go else None


def loss_of(scores: list[float], reference: list[float]) -> tuple[float, float]:
    """What some scores lack of others, in the mean over the views, and its standard error; 0 for a single view. dB."""
    losses = torch.tensor(reference, dtype=torch.float64) - torch.tensor(scores, dtype=torch.float64)
    return float(losses.mean()), float(losses.std()) / sqrt(len(losses)) if len(losses) > 1 else 0.0


def mean(scores: list[float]) -> float:
    """Over views; 0 for none."""
    return sum(scores) / max(len(scores), 1)
