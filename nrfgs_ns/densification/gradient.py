# SPDX-License-Identifier: Apache-2.0
"""Growth where screen-space gradients are large: splatfacto's densification, and 3DGS's (Kerbl et al. 2023)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove, reset_opa
from torch import Tensor

from nrfgs_ns.densification import thinning
from nrfgs_ns.densification.statistics import take_statistics
from nrfgs_ns.densification.strategy import Densification, OpacitySeen, Strategy, TrainingViews

EXTENT_MARGIN = 1.1
"""3DGS's extent of a scene: the largest distance of a training camera from their mean, times this."""
THINNED = "thinned"
"""Name in the strategy's `state`: rounds of thinning that are done."""
STRATEGY_BOUNDS = ("refine_start_iter", "refine_stop_iter", "refine_scale2d_stop_iter")
"""What begins or ends by step number in gsplat's strategy."""


@dataclass
class OriginalDensification:
    """Thresholds of 3DGS. Its schedule is in the model's warmup_length, refine_every, reset_alpha_every and
    stop_split_at, whose defaults are those of 3DGS."""

    grow_gradient: float = 2e-4
    """splats whose mean gradient of the loss by the screen position (normalised to [-1, 1]) is larger grow"""
    grow_scale: float = 0.01
    """growing splats up to this size are duplicated, larger ones are split; in extents of the cameras"""
    prune_opacity: float = 0.005
    """splats of lower opacity go; a reset brings opacities down to twice this"""
    prune_scale: float = 0.1
    """larger splats go, once opacities have been reset; in extents of the cameras"""


class PruneBySeenOpacity(DefaultStrategy):
    """gsplat's strategy with another idea of which opacity counts when splats are pruned."""

    seen_opacity: Any = None
    """Logits [N, 1] -> opacities [N]; None: the stored ones, as in gsplat."""

    @torch.no_grad()
    def _prune_gs(self, params, optimizers, state, step) -> int:
        if self.seen_opacity is None:
            return super()._prune_gs(params, optimizers, state, step)
        prune = self.seen_opacity(params["opacities"]) < self.prune_opa
        if step > self.reset_every:
            prune |= params["scales"].exp().amax(dim=-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                prune |= state["radii"] > self.prune_scale2d
        count = int(prune.sum())
        if count > 0:
            remove(params, optimizers, state, prune)
        return count


class GradientDensification(Densification):
    """Growth where screen-space gradients are large, pruning and resetting of opacities: splatfacto's, and 3DGS's.

    Args:
        name: of the strategy.
        strategy: gsplat's own, with this one's thresholds.
        opacity_seen: which opacity pruning looks at. A reset always acts on the stored one.
        scene_unit: world units in a scene unit, which sizes are measured in; None: in extents of the cameras.
        reset_at_start: reset opacities at step 0, too, as gsplat 1.4 does; 3DGS counts its steps from 1.
        keep: share of the splats that is left when growth has ended (`thinning.py`), in (0, 1].
    """

    def __init__(
        self,
        name: Strategy,
        strategy: PruneBySeenOpacity,
        opacity_seen: OpacitySeen,
        scene_unit: float | None,
        reset_at_start: bool,
        keep: float = 1.0,
    ):
        super().__init__(opacity_seen)
        self.name = name
        self.strategy = strategy
        self.bounds = {name: getattr(strategy, name) for name in STRATEGY_BOUNDS}
        self.measure_by_cameras = scene_unit is None
        self.reset_at_start = reset_at_start
        self.keep, self.state[THINNED] = keep, 0
        self.rounds = self._rounds(round)
        self.state |= strategy.initialize_state(scene_scale=scene_unit or 1.0)
        if opacity_seen == "peak":
            strategy.seen_opacity = self.seen_opacity

    def needs_absgrad(self, step: int) -> bool:
        return self.strategy.absgrad and step < self.strategy.refine_stop_iter

    @property
    def takes_all_rows(self) -> bool:
        return self.opacity_seen == "base"

    def rests_at(self, step: int) -> bool:
        return step >= self.strategy.refine_stop_iter

    def see_cameras(self, centers: Tensor) -> None:
        if self.measure_by_cameras:
            spread = (centers - centers.mean(dim=0)).norm(dim=-1).max().item()
            self.state["scene_scale"] = EXTENT_MARGIN * spread or 1.0  # one camera has no extent

    def pre_backward(self, step: int, info: Mapping[str, Any], opacities: Tensor, logits: Tensor) -> None:
        super().pre_backward(step, info, opacities, logits)
        if step < self.strategy.refine_stop_iter:
            info["means2d"].retain_grad()

    def post_backward(self, step, info, splats, optimizers) -> None:
        strategy, self.shown = self.strategy, None
        if step < strategy.refine_stop_iter:
            self._take_statistics(info, len(splats["means"]))
            if step == 0 and not self.reset_at_start:
                return
            if self._refines(step):
                self._refine(step, splats, optimizers)
            if step % strategy.reset_every == 0:
                reset_opa(splats, optimizers, self.state, value=2.0 * strategy.prune_opa)
        if step % strategy.reset_every == 0 or self._refines(step):
            self.forget_views()
        done = self.state[THINNED]
        if self.keep < 1.0 and done < len(self.rounds) and step >= self.rounds[done]:
            self._thin(step, splats, optimizers)
            self.state[THINNED] += 1

    def see_training_views(self, views: TrainingViews) -> None:
        self.views = views

    def _thin(self, step: int, splats, optimizers) -> None:
        """Take out a round's share of the splats (`thinning.py`)."""
        score = thinning.missed(self.views, len(splats["means"]), splats["means"].device)
        gone = thinning.least_missed(score, self.keep)
        remove(splats, optimizers, self.state, gone)
        if self.strategy.verbose:
            print(f"Step {step}: {int(gone.sum())} GSs thinned. Now having {len(splats['means'])} GSs.")

    def _take_statistics(self, info: Mapping[str, Any], count: int) -> None:
        """Add a step's screen-space gradients, in an image of [-1, 1], and radii, in shares of the longer side."""
        state, means2d = self.state, info["means2d"]
        gradients = means2d.absgrad if self.strategy.absgrad else means2d.grad
        for name in ("grad2d", "count", "radii"):
            if name in state and state[name] is None:
                state[name] = torch.zeros(count, device=gradients.device)
        take_statistics(state, info, gradients)

    def _refine(self, step: int, splats, optimizers) -> None:
        """Grow and prune by gsplat's rules, and begin the statistics anew."""
        strategy, state = self.strategy, self.state
        duplicated, split = strategy._grow_gs(splats, optimizers, state, step)
        grown = len(splats["means"])
        pruned = strategy._prune_gs(splats, optimizers, state, step)
        if strategy.verbose:
            print(f"Step {step}: {duplicated} GSs duplicated, {split} GSs split. Now having {grown} GSs.")
            print(f"Step {step}: {pruned} GSs pruned. Now having {len(splats['means'])} GSs.")
        for name in ("grad2d", "count", "radii"):
            if name in state:
                state[name].zero_()
        torch.cuda.empty_cache()

    def _rounds(self, step_at: Callable[[float], int]) -> list[int]:
        """The steps at which splats are thinned."""
        return [step_at(times * self.bounds["refine_stop_iter"]) for times in thinning.ROUNDS]

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        self.rounds = self._rounds(step_at)
        for name, step in self.bounds.items():
            setattr(self.strategy, name, step_at(step) if step > 0 else step)

    def _refines(self, step: int) -> bool:
        """Whether gsplat's strategy grows and prunes at this step."""
        strategy = self.strategy
        return (
            strategy.refine_start_iter < step < strategy.refine_stop_iter
            and step % strategy.refine_every == 0
            and step % strategy.reset_every >= strategy.pause_refine_after_reset
        )
