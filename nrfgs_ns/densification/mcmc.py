# SPDX-License-Identifier: Apache-2.0
"""3DGS-MCMC (Kheradmand et al. 2024): nothing is deleted, dead splats move to live ones, noise explores."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from nrfgs_ns.densification.relocation import add_samples, diffuse, relocate
from nrfgs_ns.densification.strategy import CHANGE, UNSEEN, Densification, OpacitySeen, seen_with

CHANGE_BEFORE = CHANGE + "_before"
"""As `CHANGE`, in the window before: `every` steps until the last relocation, or what would be one."""


@dataclass
class McmcDensification:
    """Constants of 3DGS-MCMC, as in gsplat. Its start and rhythm are the model's warmup_length and refine_every; it
    starts from the same splats as the other strategies."""

    min_opacity: float = 0.005
    """splats of this opacity or less are dead and move"""
    stop_at: int = 25_000
    """step after which splats neither move to others nor are added"""
    noise_lr: float = 5e5
    """size of the noise on positions, times the current learning rate of the means"""
    opacity_regularisation: float = 0.01
    """weight of the mean opacity in the loss"""
    scale_regularisation: float = 0.01
    """weight of the mean standard deviation, in scene units, in the loss"""


class Mcmc(Densification):
    """Relocation, growth to a budget, and noise (`relocation.py`).

    Args:
        config: the constants.
        budget: most splats.
        start, every: first step of, and steps between, relocations.
        opacity_seen: which opacity decides that a splat is dead and how far noise may move it. What a relocated splat
            gets is computed from the stored opacities.
        scene_unit: world units in a scene unit.

    The mean opacity in the loss is that of what the step's cameras are shown (`mean_opacity`). With the stored ones
    alone, splats that every view shows would count as dead, too, and the noise would shake them.
    """

    name = "mcmc"

    def __init__(
        self,
        config: McmcDensification,
        budget: int,
        start: int,
        every: int,
        opacity_seen: OpacitySeen,
        scene_unit: float = 1.0,
    ):
        super().__init__(opacity_seen)
        if opacity_seen == "peak":
            self.state[CHANGE_BEFORE] = None
        self.scene_unit = scene_unit
        self.config, self.budget, self.start, self.every = config, budget, start, every
        self.stop, self.bounds = config.stop_at, (start, config.stop_at)

    @torch.no_grad()
    def post_backward(self, step, info, splats, optimizers) -> None:
        self.shown = None
        if step > self.start and step % self.every == 0:
            if step < self.stop:
                self._relocate_and_add(splats, optimizers)
            self._begin_another_window()
        lr = float(optimizers["means"].param_groups[0]["lr"])
        size = self.config.noise_lr * lr / self.scene_unit**2  # times a covariance; lr is a length already
        diffuse(splats, size, self._lately_seen(splats["opacities"]))

    def _relocate_and_add(self, splats, optimizers) -> None:
        """Move the dead and grow by 5 %. A new row has been changed by views as the splat that it was made from: its
        stored opacity is another, but the head would answer for it much as for that one."""
        smallest = self.config.min_opacity
        moved = relocate(splats, optimizers, self.seen_opacity(splats["opacities"]) <= smallest, smallest)
        count = len(splats["means"])
        added = add_samples(splats, optimizers, max(0, min(self.budget, int(1.05 * count)) - count), smallest)
        if self.state.get(CHANGE) is not None:
            self.state[CHANGE] = self.state[CHANGE][moved[added]]

    def _begin_another_window(self) -> None:
        """Keep the changes until now as those before, and begin anew: until the training's end, as the noise acts."""
        if self.state.get(CHANGE) is not None:
            self.state[CHANGE_BEFORE] = self.state[CHANGE]
            self.state[CHANGE] = torch.full_like(self.state[CHANGE], UNSEEN)

    def _lately_seen(self, opacities: Tensor) -> Tensor:
        """As `seen_opacity`, over the views of the window before, too: the noise, which is there in every step, must
        not take a splat for invisible because no view has come by yet."""
        stored = torch.sigmoid(opacities.detach().flatten())
        changes = [self.state[name] for name in (CHANGE, CHANGE_BEFORE) if self.state.get(name) is not None]
        return seen_with(stored, torch.stack(changes).amax(dim=0)) if changes else stored

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        self.start, self.stop = (step_at(step) for step in self.bounds)

    def regularisation(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            "mcmc_opacity_reg": self.config.opacity_regularisation * self.mean_opacity(splats["opacities"]),
            "mcmc_scale_reg": self.config.scale_regularisation * splats["scales"].exp().mean() / self.scene_unit,
        }
