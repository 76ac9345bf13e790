# SPDX-License-Identifier: Apache-2.0
"""3DGS-MCMC (Kheradmand et al. 2024): nothing is deleted, dead splats move to live ones, noise explores.

A live splat of opacity o that is replaced by n copies of itself at the same place looks the same from everywhere if
each copy has (equation 9 of the paper)

    o' = 1 - (1 - o)^(1/n),
    s' = s o / sum_{i=1..n} sum_{k=0..i-1} binom(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).

gsplat 1.4 has these moves too, but two of its steps exist as CUDA kernels only. Here is the same mathematics for every
device; the sum over i is done in closed form, sum_{i=1..n} binom(i-1, k) = binom(n, k+1).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from gsplat.strategy.ops import _update_param_with_optimizer
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor
from torch.nn import Parameter

from nrfgs_ns.densification.strategy import Densification, DensificationConfig, OpacitySeen, Optimizers, Splats

LARGEST_BUDGET = 2**24
"""`torch.multinomial` draws from no more categories than this."""
MIN_OPACITY = 0.005
"""Splats of this opacity or less are dead and move; no move leaves a splat below it."""
NOISE_LR = 5e5
"""Size of the noise on positions, times the current learning rate of the means."""
SCALE_REGULARISATION = 0.01
"""Weight of the mean standard deviation, in scene units, in the loss."""
MAX_COPIES = 51
"""n is cut off here, as in gsplat: the alternating sum loses its digits as n grows."""
NOISE_SHARPNESS = 100.0
"""The noise's sigmoid falls from 1 to 0 around `MIN_OPACITY` with this slope: live splats hold still."""


@dataclass
class Mcmc(DensificationConfig):
    """3DGS-MCMC (Kheradmand et al. 2024) up to a budget of splats, with gsplat's constants."""

    name: ClassVar[str] = "mcmc"
    copies_splats: ClassVar[bool] = True
    regularises: ClassVar[bool] = True
    opacity_seen: OpacitySeen = "peak"
    """opacity by which splats are pruned or replaced (docs/deviations.md). base: stored. peak: largest shown lately"""
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
    """Relocation, growth to a budget, and noise.

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

    def change_splats(self, step, info, splats, optimizers) -> None:
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
        moved_from = relocate(splats, optimizers, dead)
        wanted = max(min(self.budget, int(1.05 * count)) - count, 0)
        wanted = self.room_for(step, info, splats, optimizers, wanted)
        made_from = add_samples(splats, optimizers, wanted)
        self.take_rows(moved_from[made_from])

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        self.start, self.stop = step_at(self.config.warmup_length), step_at(self.config.stop_at)

    def regularisation(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            "mcmc_opacity_reg": self.config.opacity_regularisation * self.mean_opacity(splats["opacities"]),
            "mcmc_scale_reg": SCALE_REGULARISATION * splats["scales"].exp().mean() / self.scene_unit,
        }


def split_evenly(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scales of each of n copies that together look like the one splat (equation 9).

    Args:
        opacities: [M] in (0, 1).
        scales: standard deviations [M, 3].
        copies: n, int64 [M], cut off at 51.

    Returns:
        o' [M] and s' [M, 3].
    """
    n = copies.clamp(1, MAX_COPIES)
    # float64, and o short of 1: the terms alternate, and for n = 51 they are up to 1e5 times as large as their sum.
    o = opacities.double().clamp_max(1.0 - torch.finfo(torch.float32).eps)
    each = -torch.expm1(torch.log1p(-o) / n)
    k = torch.arange(MAX_COPIES, device=o.device)
    signs = (1.0 - 2.0 * (k % 2)) / (k + 1.0).sqrt()
    terms = _BINOMIALS.to(o.device)[n] * signs * each[:, None] ** (k + 1)  # [M, 51]
    factor = o / terms.sum(dim=-1)
    return each.to(opacities.dtype), (factor[:, None] * scales).to(scales.dtype)


_BINOMIALS = torch.tensor([[math.comb(n, k + 1) for k in range(MAX_COPIES)] for n in range(MAX_COPIES + 1)]).double()
"""binom(n, k + 1), [52, 51]; all are below 2^53."""


@torch.no_grad()
def relocate(splats: Splats, optimizers: Optimizers, dead: Tensor) -> Tensor:
    """Move dead splats onto live ones, drawn in proportion to their opacity; each place is then shared evenly.

    As in gsplat, the drawn splats' moments are set to zero, and those of the dead stay what they were.

    Args:
        splats: the table; entries are replaced.
        optimizers: of each entry, by its name.
        dead: bool [N].

    Returns:
        The row that each row was made from, int64 [N]. If none is alive, all stay as they are.
    """
    source = torch.arange(len(dead), device=dead.device)
    dead_rows, live_rows = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
    if len(dead_rows) == 0 or len(live_rows) == 0:
        return source
    source[dead_rows] = chosen = _share_places(splats, live_rows, len(dead_rows))

    def moments(_: str, old: Tensor) -> Tensor:
        return old.index_fill(0, chosen, 0.0)

    _update_param_with_optimizer(lambda _, old: Parameter(old.detach()[source]), moments, splats, optimizers)
    return source


@torch.no_grad()
def add_samples(splats: Splats, optimizers: Optimizers, count: int) -> Tensor:
    """Add `count` splats onto existing ones, drawn in proportion to their opacity; each place is then shared evenly.

    Args: see `relocate`. The new rows come last, with zero moments; the drawn splats keep theirs, as in gsplat.

    Returns:
        The row that each row was made from, int64 [N + count].
    """
    rows = torch.arange(len(splats["means"]), device=splats["means"].device)
    if count <= 0:
        return rows
    source = torch.cat([rows, _share_places(splats, rows, count)])

    def moments(_: str, old: Tensor) -> Tensor:
        return torch.cat([old, old.new_zeros(count, *old.shape[1:])])

    _update_param_with_optimizer(lambda _, old: Parameter(old.detach()[source]), moments, splats, optimizers)
    return source


def _share_places(splats: Splats, rows: Tensor, count: int) -> Tensor:
    """Draw `count` of `rows` and make each of them one of several copies, in place.

    Returns:
        the drawn rows, int64 [count], with repetitions.
    """
    opacities = torch.sigmoid(splats["opacities"]).flatten()
    chosen = rows[torch.multinomial(opacities[rows], count, replacement=True)]
    copies = torch.bincount(chosen, minlength=len(opacities))[chosen] + 1  # the drawn splat stays as one of them
    each, scales = split_evenly(opacities[chosen], splats["scales"][chosen].exp(), copies)
    each = each.clamp(MIN_OPACITY, 1.0 - torch.finfo(each.dtype).eps)
    splats["opacities"].data[chosen] = torch.logit(each)[:, None]
    splats["scales"].data[chosen] = scales.log()
    return chosen


@torch.no_grad()
def add_noise(splats: Splats, size: float, opacities: Tensor) -> None:
    """Add noise to the means, along each splat's own shape: covariance @ N(0, 1) * size * gate(opacity).

    The gate, 1 / (1 + exp(100 (opacity - 0.005))), lets only splats explore that cannot be seen.

    Args:
        splats: the table; `means` changes in place.
        size: learning rate of the means times the noise's own.
        opacities: the splats', as they are seen, [N] in [0, 1].
    """
    gate = torch.sigmoid(-NOISE_SHARPNESS * (opacities - MIN_OPACITY))
    noise = torch.randn_like(splats["means"]) * (gate * size)[:, None]
    axes = normalized_quat_to_rotmat(F.normalize(splats["quats"], dim=-1))
    along = torch.einsum("nij,ni->nj", axes, noise) * (2.0 * splats["scales"]).exp()
    splats["means"].add_(torch.einsum("nij,nj->ni", axes, along))
