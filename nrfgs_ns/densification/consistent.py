# SPDX-License-Identifier: Apache-2.0
r"""Growth where several training views agree that the picture is wrong: the rule of FastGS (Ren et al. 2026, arXiv
2511.04283), on top of splatfacto's.

Each refinement looks at K training views. Of view j, e_j(p) is the error of pixel p, its mean absolute difference to
the photograph over the channels, brought to [0, 1] by the view's smallest and largest, and L_j the view's photometric
loss. A pixel is wrong if e_j(p) is above a threshold. Splat i has of view j the wrong pixels

    n_ij = sum over wrong pixels p of alpha_i(p) T_i(p),

each pixel shared among the splats that it is made of (FastGS counts it whole for each splat whose footprint covers it).

- A splat grows where splatfacto would grow it, if the mean of n_ij over the K views is large enough, too. One view that
  could be fitted better is no reason; large gradients on few wrong pixels are none either.
- A splat goes if sum_j L_j n_ij, brought to [0, 1] by the smallest and largest of all splats, is above a threshold.
- A splat goes if fewer than two training views show it. Views are dealt like cards, K at a time until all have had
  their turn, so that this is known after V / K refinements, at no further cost.

Opacities are those that the head shows to each view. Which views are looked at depends on the seed and on how many
have been: a training that goes on from a checkpoint looks at those of the unbroken one.
"""

import math
from dataclasses import dataclass

import torch
from gsplat.strategy.ops import remove
from torch import Tensor

from nrfgs_ns.densification.gradient import GradientDensification, PruneBySeenOpacity
from nrfgs_ns.densification.strategy import OpacitySeen, TrainingViews
from nrfgs_ns.errors import InputError

SHOWN = 0.1
"""Pixels of a view that a splat must be, alpha T summed, for that view to show it."""
FEWEST_VIEWS = 4
"""With fewer training views a splat that only one of them shows may be all that is known of its place."""
VIEWED, FIRST_VIEW, SUPPORTED = "viewed", "first_view", "supported"
"""Names in the strategy's `state`: views looked at since the start; the first view of this deal that shows each splat,
-1 for none, [N]; whether a second one does, [N]."""
CONFIRMED, RADII = "confirmed", "radii_before"
"""Names in `state` during a refinement: whether the views confirm that a splat should grow; its radius, [N]."""


@dataclass
class ConsistentDensification:
    """What the densification 'consistent' adds to splatfacto's thresholds and schedule."""

    views: int = 10
    """training views that a refinement looks at"""
    wrong: float = 0.1
    """error above which a pixel is wrong, in [0, 1]: that of the view's smallest to its largest"""
    grow_pixels: float = 0.2
    """splats with more wrong pixels of the photographs than that, in the mean over the views, may grow. More: fewer
    splats"""
    prune_score: float = 0.9
    """splats whose wrong pixels, weighted by the views' losses, are above this share of the largest go. 1: none"""
    prune_unsupported: bool = True
    """whether splats that fewer than two training views show go"""

    def check(self) -> None:
        """Raise InputError where a number is out of range."""
        for name, holds, needed in (
            ("views", self.views >= 1, "at least 1"),
            ("wrong", 0.0 <= self.wrong < 1.0, "at least 0 and below 1"),
            ("grow_pixels", self.grow_pixels >= 0.0, "zero or positive"),
            ("prune_score", 0.0 <= self.prune_score <= 1.0, "between 0 and 1"),
        ):
            if not holds:
                raise InputError(f"pipeline.model.consistent.{name} is {getattr(self, name)}; it must be {needed}.")


class Consistent(GradientDensification):
    """Splatfacto's growth and pruning, where several views agree (module docstring).

    Args:
        config: what is added to splatfacto's rules.
        strategy: splatfacto's thresholds.
        opacity_seen: which opacity splatfacto's pruning looks at.
        scene_unit: world units in a scene unit.
        seed: which views are looked at, and when.
    """

    views: TrainingViews | None = None

    def __init__(
        self,
        config: ConsistentDensification,
        strategy: PruneBySeenOpacity,
        opacity_seen: OpacitySeen,
        scene_unit: float,
        seed: int,
    ):
        super().__init__("consistent", strategy, opacity_seen, scene_unit, reset_at_start=True)
        self.config, self.seed = config, seed
        self.state |= {VIEWED: 0, FIRST_VIEW: None, SUPPORTED: None}

    def see_training_views(self, views: TrainingViews) -> None:
        self.views = views

    @torch.no_grad()
    def _grow(self, step: int, splats, optimizers) -> tuple[int, int]:
        """Prune by what the views say, then grow what they confirm. Rows that are made follow those of all state."""
        grow, prune = self._judge(len(splats["means"]), splats["means"].device)
        state = self.state
        state[CONFIRMED] = grow
        if prune.any() and not prune.all():
            remove(splats, optimizers, state, prune)
        confirmed = state.pop(CONFIRMED)
        state["grad2d"] = state["grad2d"] * confirmed
        by_size = "radii" in state
        if by_size:
            state[RADII], state["radii"] = state["radii"], state["radii"] * confirmed
        grown = super()._grow(step, splats, optimizers)
        if by_size:  # what is too large for the picture goes, confirmed or not
            state["radii"] = state.pop(RADII)
        return grown

    def _judge(self, count: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Which of the splats may grow, and which must go: bool [N] each."""
        config, state = self.config, self.state
        if state[FIRST_VIEW] is None:
            state[FIRST_VIEW] = torch.full((count,), -1, device=device)
            state[SUPPORTED] = torch.zeros(count, dtype=torch.bool, device=device)
        indices, ends_a_deal = self._deal()
        wrong, blame = torch.zeros(2, count, device=device)
        for index in indices:
            seen = self.views.look(index, config.wrong)
            wrong.index_add_(0, seen.rows, seen.wrong)
            blame.index_add_(0, seen.rows, seen.wrong * seen.loss)
            shown = seen.rows[seen.pixels >= SHOWN]
            first = state[FIRST_VIEW][shown]
            state[FIRST_VIEW][shown] = torch.where(first < 0, index, first)
            state[SUPPORTED][shown] |= first >= 0
        span = blame.max() - blame.min()
        prune = (blame - blame.min()) > config.prune_score * span
        if ends_a_deal:
            if config.prune_unsupported:
                prune |= ~state[SUPPORTED]
            state[FIRST_VIEW].fill_(-1)
            state[SUPPORTED].zero_()
        return wrong > config.grow_pixels * len(indices), prune

    def _deal(self) -> tuple[list[int], bool]:
        """The views to look at now, and whether all have had their turn then, and are enough to ask for support."""
        count = len(self.views)
        deal, place = divmod(self.state[VIEWED], count)
        # Two odd numbers of 64 bits, so that neighbouring deals and seeds have nothing to do with each other.
        key = (self.seed * 0x9E3779B97F4A7C15 + deal * 0xBF58476D1CE4E5B9) % 2**63
        order = torch.randperm(count, generator=torch.Generator().manual_seed(key ^ key >> 31)).tolist()
        share = math.ceil(count / math.ceil(count / self.config.views))
        end = min(place + share, count)
        self.state[VIEWED] += end - place
        return order[place:end], end == count >= FEWEST_VIEWS
