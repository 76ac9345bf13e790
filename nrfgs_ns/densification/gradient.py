# SPDX-License-Identifier: Apache-2.0
"""Growth where screen-space gradients are large: splatfacto's densification, and 3DGS's (Kerbl et al. 2023)."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove, reset_opa
from torch import Tensor

from nrfgs_ns.data.checks import warn
from nrfgs_ns.densification.statistics import Statistics, accumulate
from nrfgs_ns.densification.strategy import Densification, DensificationConfig

EXTENT_MARGIN = 1.1
"""3DGS's extent of a scene: the largest distance of a training camera from their mean, times this."""
THRESHOLD = "log_threshold"
"""Name in the strategy's `state`: logarithm of what the gradient's threshold is multiplied by, to meet a budget."""
RECOVERY = 3
"""Refinements after a reset of opacities at which a training with a budget prunes nothing."""
DEAD_BAND = 0.01
"""Share by which the number of splats may differ from `planned_count` before the threshold moves."""
LARGEST_STEP = 0.12
"""Largest change of the threshold's logarithm at a refinement."""
STRATEGY_BOUNDS = ("refine_start_iter", "refine_stop_iter", "refine_scale2d_stop_iter")
"""What begins or ends by step number in gsplat's strategy."""


@dataclass
class GradientConfig(DensificationConfig):
    """Options that splatfacto's and 3DGS's rules share."""

    stop_split_at: int = 15_000
    """step at which growth ends"""
    reset_alpha_every: int = 30
    """refinements between two resets of opacities"""
    budget: int = 0
    """number of splats to grow to (arXiv 2605.16158). 0: the threshold decides"""

    def check(self) -> None:
        super().check()
        self.require(self.reset_alpha_every >= 1, "reset_alpha_every", "at least 1")

    def _rules(self, **thresholds: Any) -> DefaultStrategy:
        """Rules of gsplat with these thresholds, under the names of its `DefaultStrategy`."""
        return DefaultStrategy(
            refine_start_iter=self.warmup_length,
            refine_stop_iter=self.stop_split_at,
            refine_every=self.refine_every,
            reset_every=self.reset_alpha_every * self.refine_every,
            **thresholds,
        )


@dataclass
class Splatfacto(GradientConfig):
    """nerfstudio's rules, with splatfacto's names and defaults."""

    name: ClassVar[str] = "splatfacto"
    densify_grad_thresh: float = 0.0008
    """mean gradient by the screen position (in [-1, 1]) above which splats grow; absolute values are summed (AbsGS)"""
    cull_alpha_thresh: float = 0.1
    """opacity below which splats are pruned; a reset lowers opacities to twice this"""

    def check(self) -> None:
        super().check()
        resets = "below 0.5 and above 0, since a reset is to twice as much"
        self.require(0 < self.cull_alpha_thresh < 0.5, "cull_alpha_thresh", resets)

    def build(self, num_images: int, num_views: int, scene_unit: float) -> "GradientDensification":
        rules = self._rules(
            prune_opa=self.cull_alpha_thresh,
            grow_grad2d=self.densify_grad_thresh,
            grow_scale3d=0.01,  # in scene units, as the next: larger ones are split, not duplicated
            prune_scale3d=0.5,
            grow_scale2d=0.05,  # shares of the image
            prune_scale2d=0.15,
            refine_scale2d_stop_iter=4000,
            pause_refine_after_reset=num_images + self.refine_every,
            absgrad=True,
        )
        return GradientDensification(self, rules, scene_unit)


@dataclass
class Original(GradientConfig):
    """3DGS's rules (Kerbl et al. 2023), with its thresholds."""

    name: ClassVar[str] = "original"

    def build(self, num_images: int, num_views: int, scene_unit: float) -> "GradientDensification":
        return OriginalDensification(self, self._rules())  # gsplat's default thresholds are 3DGS's


class GradientDensification(Densification):
    """Growth where screen-space gradients are large, pruning and resetting of opacities, as in splatfacto.

    Args:
        config: its options. `opacity_seen` is what pruning looks at; a reset always acts on the stored one.
        strategy: gsplat's own, with this one's thresholds.
        scene_unit: world units in a scene unit, which sizes are measured in.
    """

    def __init__(self, config: GradientConfig, strategy: DefaultStrategy, scene_unit: float = 1.0):
        super().__init__(config)
        self.strategy = strategy
        self.gradients = "absolute" if strategy.absgrad else "signed"
        self.bounds = {name: getattr(strategy, name) for name in STRATEGY_BOUNDS}
        self.threshold, self.widest = strategy.grow_grad2d, strategy.grow_scale2d
        if self.budget:
            self.state[THRESHOLD] = 0.0
        self.state |= strategy.initialize_state(scene_scale=scene_unit)

    def rests_at(self, step: int) -> bool:
        return step >= self.strategy.refine_stop_iter

    def begin(self, centers: Tensor, num_splats: int, pixels: int) -> None:
        super().begin(centers, num_splats, pixels)
        rules = self.strategy
        if self.verbose and rules.pause_refine_after_reset > rules.reset_every - rules.refine_every:
            pause = f"each reset of opacities pauses it for {rules.pause_refine_after_reset} steps, until the next"
            warn(f"{self.name} never refines: {pause}. Give more reset_alpha_every.")

    def change_splats(self, step, info, splats, optimizers) -> None:
        strategy = self.strategy
        self.take_changes(info, len(splats["means"]))
        if step < strategy.refine_stop_iter:
            self._update_statistics(info, len(splats["means"]))
            if self._refines(step):
                self._refine(step, info, splats, optimizers)
            if self._resets(step):
                reset_opa(splats, optimizers, self.state, value=2.0 * strategy.prune_opa)
        if self._resets(step) or self._refines(step):
            self.begin_another_window()

    def _update_statistics(self, info: Mapping[str, Any], count: int) -> None:
        """Add a step's screen-space gradients, in an image of [-1, 1], and radii, in shares of the longer side."""
        state = self.state
        means2d = info["means2d"]
        gradients = means2d.absgrad if self.strategy.absgrad else means2d.grad
        self.make_tables(("grad2d", "count", "radii"), count, gradients.device)
        accumulate(Statistics(state.get("radii"), state["grad2d"], state["count"]), info, 2.0, gradients)

    def _refine(self, step: int, info: Mapping[str, Any], splats, optimizers) -> None:
        """Grow and prune by gsplat's rules, and begin the statistics anew."""
        strategy, state = self.strategy, self.state
        count = len(splats["means"])
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        threshold = self._threshold_for_budget(step, gradients) if self.budget else self.threshold
        strategy.grow_grad2d, strategy.grow_scale2d = threshold, self.widest
        growing = gradients > threshold
        if step < strategy.refine_scale2d_stop_iter:
            growing |= state["radii"] > self.widest
        wanted = int(growing.sum())
        if (room := self.room_for(step, info, splats, optimizers, wanted)) < wanted:
            largest = gradients.kthvalue(count - room).values.item()  # the threshold is exclusive
            strategy.grow_grad2d, strategy.grow_scale2d = max(threshold, largest), math.inf
        duplicated, split = strategy._grow_gs(splats, optimizers, state, step)
        grown = len(splats["means"])
        pruned = 0
        if not self.budget or step % strategy.reset_every >= RECOVERY * strategy.refine_every:
            pruned = self._prune(step, splats, optimizers)
        if self.verbose:
            print(f"Step {step}: {duplicated} GSs duplicated, {split} GSs split. Now having {grown} GSs.")
            print(f"Step {step}: {pruned} GSs pruned. Now having {len(splats['means'])} GSs.")
        for name in ("grad2d", "count", "radii"):
            if name in state:
                state[name].zero_()
        torch.cuda.empty_cache()

    def _prune(self, step: int, splats, optimizers) -> int:
        """Remove splats by gsplat's rules, except that `seen_opacity` counts; return their number."""
        strategy, state = self.strategy, self.state
        prune = self.seen_opacity(splats["opacities"]) < strategy.prune_opa
        if step > strategy.reset_every:
            prune |= splats["scales"].exp().amax(dim=-1) > strategy.prune_scale3d * state["scene_scale"]
            if step < strategy.refine_scale2d_stop_iter:
                prune |= state["radii"] > strategy.prune_scale2d
        count = int(prune.sum())
        if count > 0:
            remove(splats, optimizers, state, prune)
        return count

    def _threshold_for_budget(self, step: int, gradients: Tensor) -> float:
        """The gradient above which splats grow at this refinement, so that growth ends with the budget's number.

        Where the number is off its `planned_count`, the threshold's logarithm moves, by at most `LARGEST_STEP`. Growth
        by gradients [N] stops at the planned number; wide splats may be split besides.
        """
        state = self.state
        count = len(gradients)
        goal = self.planned_count(step, count, self.strategy.refine_start_iter, self.strategy.refine_stop_iter)
        if abs(count - goal) > DEAD_BAND * goal:
            state[THRESHOLD] += max(-LARGEST_STEP, min(math.log(count / goal), LARGEST_STEP))
        threshold = self.threshold * math.exp(state[THRESHOLD])
        room = max(round(goal) - count, 0)
        if room < count:  # the threshold is exclusive
            threshold = max(threshold, gradients.kthvalue(count - room).values.item())
        return threshold

    def reschedule(self, step_at: Callable[[float], int]) -> None:
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

    def _resets(self, step: int) -> bool:
        """Whether opacities are reset at this step, while splats grow. gsplat 1.4 counts steps from 0."""
        return step % self.strategy.reset_every == 0


class OriginalDensification(GradientDensification):
    """The same as in 3DGS: sizes are measured in extents of the cameras, and steps count from 1."""

    def begin(self, centers: Tensor, num_splats: int, pixels: int) -> None:
        super().begin(centers, num_splats, pixels)
        spread = (centers - centers.mean(dim=0)).norm(dim=-1).max().item()
        self.state["scene_scale"] = EXTENT_MARGIN * spread or 1.0  # one camera has no extent

    def _resets(self, step: int) -> bool:
        return step > 0 and super()._resets(step)
