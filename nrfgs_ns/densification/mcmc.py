# SPDX-License-Identifier: Apache-2.0
"""3DGS-MCMC (Kheradmand et al. 2024): nothing is deleted, dead splats move to live ones, noise explores."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from nrfgs_ns.densification.relocation import add_noise, add_samples, relocate
from nrfgs_ns.densification.strategy import Densification, DensificationConfig, OpacitySeen, Optimizers, Splats

LARGEST_BUDGET = 2**24
"""`torch.multinomial` draws from no more categories than this."""
MIN_OPACITY = 0.005
"""Splats of this opacity or less are dead and move."""
NOISE_LR = 5e5
"""Size of the noise on positions, times the current learning rate of the means."""
SCALE_REGULARISATION = 0.01
"""Weight of the mean standard deviation, in scene units, in the loss."""


@dataclass
class Mcmc(DensificationConfig):
    """3DGS-MCMC (Kheradmand et al. 2024) up to a budget of splats, with gsplat's constants."""

    name: ClassVar[str] = "mcmc"
    copies_splats: ClassVar[bool] = True
    regularises: ClassVar[bool] = True
    opacity_seen: OpacitySeen = "peak"
    """opacity by which splats are pruned, moved or replaced (docs/deviations.md). base: stored. peak: largest shown
    lately"""
    budget: int = 1_000_000
    """number of splats to grow to and to keep"""
    stop_at: int = 25_000
    """step after which splats are neither added nor moved nor replaced"""
    opacity_regularisation: float = 0.01
    """weight of the mean opacity in the loss"""

    def check(self) -> None:
        super().check()
        self.require(1 <= self.budget <= LARGEST_BUDGET, "budget", f"from 1 to {LARGEST_BUDGET}")

    def build(self, num_images: int, num_views: int, scene_unit: float) -> "McmcDensification":
        return McmcDensification(self, scene_unit)


class McmcDensification(Densification):
    """Relocation, growth to a budget, and noise (`relocation.py`).

    The seen opacity (`seen_opacity`) decides whether a splat is dead, and how far noise may move it: by the stored one,
    splats that every view shows could count as dead, and the noise would shake them. What a relocated splat gets is
    computed from stored opacities. The loss takes the mean of the opacities that the step shows (`mean_opacity`).
    """

    def __init__(self, config: Mcmc, scene_unit: float):
        super().__init__(config, windows=2)
        self.scene_unit = scene_unit
        self.reschedule(round)

    def rests_at(self, step: int) -> bool:
        return step >= self.stop

    @torch.no_grad()
    def post_backward(self, step, info, splats, optimizers) -> None:
        self.shown = None
        self.take_changes(info, len(splats["means"]))
        if step > self.start and step % self.config.refine_every == 0:
            if step < self.stop:
                self._relocate_and_add(step, info, splats, optimizers)
            self.begin_another_window()  # until the training's end, as the noise acts
        lr = float(optimizers["means"].param_groups[0]["lr"])
        size = NOISE_LR * lr / self.scene_unit**2  # times a covariance; lr is a length already
        # In every step: it must not take a splat for invisible because no view of this window has come by yet.
        add_noise(splats, size, self.seen_opacity(splats["opacities"]))

    def _relocate_and_add(self, step: int, info: Mapping[str, Any], splats: Splats, optimizers: Optimizers) -> None:
        """Move the dead and grow by 5 %, up to the budget.

        A moved or new row takes over the change of opacity of the splat that it was made from. Their stored opacities
        differ, but the head changes both alike.
        """
        dead = self.seen_opacity(splats["opacities"], before=False) <= MIN_OPACITY
        count = len(splats["means"])
        moved_from = relocate(splats, optimizers, dead, MIN_OPACITY)
        wanted = max(min(self.budget, int(1.05 * count)) - count, 0)
        wanted = self.room_for(step, info, splats, optimizers, wanted)
        made_from = add_samples(splats, optimizers, wanted, MIN_OPACITY)
        self.take_rows(moved_from[made_from], count)

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        self.start, self.stop = step_at(self.config.warmup_length), step_at(self.config.stop_at)

    def regularisation(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            "mcmc_opacity_reg": self.config.opacity_regularisation * self.mean_opacity(splats["opacities"]),
            "mcmc_scale_reg": SCALE_REGULARISATION * splats["scales"].exp().mean() / self.scene_unit,
        }
