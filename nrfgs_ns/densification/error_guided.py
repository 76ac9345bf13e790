# SPDX-License-Identifier: Apache-2.0
"""Growth where the error is, to a number of splats that the capture decides.

The recipe follows brush (Arthur Brussee, Apache-2.0, `crates/brush-train`) and LichtFeld-Studio's default:

- A splat's *error* is the sum over pixels of |dL/dmean2d|, with screen positions in widths and heights of the image.
  Of the views since the last refinement the largest counts. It does not depend on the size of the images, the number of
  views or the unit of the scene.
- Each refinement splits a share of the splats whose error is above a threshold, drawn in proportion to the error, and
  every splat whose radius, three standard deviations, exceeds three quarters of the image's longer side.
- A splat is dead if no view of the last two windows shows it at `DEAD` or more; of one that none has seen the stored
  opacity counts. It is replaced by half of a live one, drawn in proportion to opacity.
- Opacities are never reset. Each refinement takes a little from all of them, which the loss gives back where it counts.

Differences from both, because they harm captures of few views (docs/captures.md): `DEAD` is 0.1 where they have 1/255,
wide splats are split and not replaced, and no noise moves the means. The loss has a term for opacity and size
(`shrinkage`).
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

from nrfgs_ns.densification.statistics import Statistics, accumulate
from nrfgs_ns.densification.strategy import Densification, DensificationConfig, OpacitySeen, Optimizers, Splats

ERROR = "error"
"""Name in `state`: the largest error of each splat in a view of this window, [N]."""
WIDTH = "width"
"""Name in `state`: the largest radius of each splat in this window, in longer sides of the image, [N]; 0: not seen."""
DEAD = 0.1
"""Splats that no view of two windows shows at this opacity or more are replaced."""
SHARE = 0.25
"""Share of the splats above the threshold that a refinement splits."""
DECAY = 0.004
"""Opacity that the first refinement takes from each splat; the amount falls linearly to 0 over the training."""
LAYOUT = 30_000
"""Steps of the training that the options' steps belong to."""
MANY_VIEWS = 300
"""Training views that double the threshold: their trainings are longer, and more splats would cost them much time."""
WIDEST = 0.75
"""Radius from which a splat is split whatever its error: three standard deviations, in longer sides of the image."""


@dataclass
class ErrorGuided(DensificationConfig):
    """Growth where the error is: the number of splats follows from the capture."""

    name: ClassVar[str] = "error-guided"
    counts: ClassVar[tuple[str, ...]] = ("budget", "most_splats")
    copies_splats: ClassVar[bool] = True
    opacity_seen: OpacitySeen = "peak"
    """opacity by which splats are pruned or replaced (docs/deviations.md). base: stored. peak: largest shown lately"""
    refine_every: int = 200
    """steps between refinements"""
    threshold: float = 0.0025
    """error above which a splat may be split: less gives more detail. V training views multiply it by 1 + (V /
    300)^2"""
    budget: int = 0
    """number of splats to grow to (arXiv 2605.16158). 0: the threshold decides"""
    most_splats: int = 2_000_000
    """upper bound; growth usually ends below it"""
    shrinkage: float = 0.2
    """constant weight added to the model's, in percent, since no reset removes large faint splats"""
    grow_until: int = 15_000
    """step after which splats are only replaced"""
    stop_at: int = 25_000
    """step after which splats are neither added nor moved nor replaced"""

    def check(self) -> None:
        super().check()
        self.require(self.most_splats >= 1, "most_splats", "at least 1")
        self.require(self.budget <= self.most_splats, "budget", f"at most most_splats, {self.most_splats}")

    def build(self, num_images: int, num_views: int, scene_unit: float) -> "ErrorGuidedDensification":
        return ErrorGuidedDensification(self, self.threshold * (1 + (num_views / MANY_VIEWS) ** 2))


class ErrorGuidedDensification(Densification):
    """Splits by error, replacement by opacity, decay of opacity."""

    gradients = "absolute"

    def __init__(self, config: ErrorGuided, threshold: float):
        super().__init__(config, windows=2)
        self.state |= {ERROR: None, WIDTH: None}
        self.threshold = threshold
        self.reschedule(round)

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        config = self.config
        self.start, self.grow_until = step_at(config.warmup_length), step_at(config.grow_until)
        self.stop, self.end = step_at(config.stop_at), step_at(LAYOUT)

    def rests_at(self, step: int) -> bool:
        return step >= self.grow_until

    # What a step shows.

    def change_splats(self, step, info, splats, optimizers) -> None:
        if step >= self.stop:
            return
        self._update_statistics(step, info, len(splats["means"]))
        if step > self.start and step % self.config.refine_every == 0:
            self._refine(step, info, splats, optimizers)
            self.begin_another_window()
            self.state[ERROR].zero_()
            self.state[WIDTH].zero_()

    def _update_statistics(self, step: int, info: Mapping[str, Any], count: int) -> None:
        """Let the window's maxima be at least the step's; errors only while splats grow."""
        self.take_changes(info, count)
        self.make_tables((ERROR, WIDTH), count, info["radii"].device)
        grows = step < self.grow_until
        norms, gradients = (self.state[ERROR], info["means2d"].absgrad) if grows else (None, None)
        accumulate(Statistics(self.state[WIDTH], norms), info, 1.0, gradients)

    # What a refinement does.

    def _refine(self, step: int, info: Mapping[str, Any], splats: Splats, optimizers: Optimizers) -> None:
        """Replace the dead, split where the error is, and take a little from all opacities."""
        self.moved_at = step
        count = len(splats["means"])
        width = self.state[WIDTH]
        opacities = self.seen_opacity(splats["opacities"])
        dead = opacities < DEAD
        alive_and_seen = (opacities * (width > 0)).masked_fill(dead, 0.0)
        parents = draw(alive_and_seen, int(dead.sum()))
        places = dead.nonzero()[:, 0][: len(parents)]
        grown = parents[:0]
        if step < self.grow_until:
            weights, wanted = self._candidates(step, count, dead, width > WIDEST, len(places))
            wanted = max(min(wanted, self.config.most_splats - count), 0)
            wanted = self.room_for(step, info, splats, optimizers, wanted)
            grown = draw(weights.index_fill(0, parents, 0.0), wanted)
        split(splats, optimizers, torch.cat([parents, grown]), places)
        made_from = torch.cat([torch.arange(count, device=dead.device).index_copy(0, places, parents), grown])
        self.take_rows(made_from)
        self._decay_opacities(step, splats["opacities"])
        if self.verbose:
            print(f"Step {step}: {len(places)} GSs replaced, {len(grown)} split. Now having {count + len(grown)} GSs.")

    def _decay_opacities(self, step: int, logits: Parameter) -> None:
        """Take from each stored opacity `DECAY` at first, falling linearly to 0 at the training's end. [N, 1]"""
        opacities = torch.sigmoid(logits.detach()) - DECAY * (1 - min(step / max(self.end, 1), 1.0))
        logits.data.copy_(torch.logit(opacities.clamp(1e-6, 1 - torch.finfo(opacities.dtype).eps)))

    def _candidates(self, step: int, count: int, dead: Tensor, wide: Tensor, replaced: int) -> tuple[Tensor, int]:
        """Weights [N] by which splats are drawn to be split, wide ones first, and how many are wanted.

        Without a budget: `SHARE` of the splats above the threshold, minus the `replaced` ones, but at least all wide
        ones. With a budget: as many as are missing from `planned_count`.

        Args:
            dead, wide: bool [N].
        """
        error = self.state[ERROR].masked_fill(dead, 0.0)
        wide = wide & ~dead
        if self.budget:
            wanted = round(self.planned_count(step, count, self.start, self.grow_until)) - count
            return error.masked_fill(wide, math.inf), wanted
        weights = error * (error > self.threshold)
        wanted = max(round(SHARE * int((weights > 0).sum())) - replaced, int(wide.sum()))
        return weights.masked_fill(wide, math.inf), wanted


def draw(weights: Tensor, count: int) -> Tensor:
    """Draw different rows in proportion to their weights: at most `count`, and as many as have a positive weight.

    Args:
        weights: [N], not negative.

    Returns:
        rows, int64 [at most count].
    """
    possible = weights.nonzero()[:, 0]
    count = min(max(count, 0), len(possible))
    if count == 0:
        return possible[:0]
    # The largest of u^(1/w) (Efraimidis and Spirakis 2006): `torch.multinomial` takes no more than 2^24 rows.
    keys = torch.rand(len(possible), device=weights.device, dtype=torch.float64).log() / weights[possible].double()
    return possible[keys.topk(count).indices]


def halves(splats: Mapping[str, Tensor], rows: Tensor, signs: Tensor) -> dict[str, Tensor]:
    """Geometry and opacity of the two halves of each splat: the variance along each axis stays, the longest axis is
    shortened most, and both together are about as opaque.

    Args:
        splats: the table.
        rows: splats to be split, int64 [M].
        signs: -1 or 1 for each axis, [M, 3].

    Returns:
        "scales" (log) [M, 3] and "opacities" (logits) [M, 1] of both, "offset" [M, 3] of one's mean, and the other's is
        its negative.
    """
    log_scales = splats["scales"].detach()[rows]
    scales = log_scales.exp()
    shrunk = 1 - (1 - math.sqrt(0.5)) * (scales / scales.amax(dim=-1, keepdim=True)) ** 2
    axes = normalized_quat_to_rotmat(F.normalize(splats["quats"].detach()[rows], dim=-1))
    local = signs * (1 - shrunk**2).sqrt() * scales
    logits = splats["opacities"].detach()[rows].double()
    # log(1 - o') = log(1 - o) / sqrt 2
    clear = F.logsigmoid(-logits) * math.sqrt(0.5)
    return {
        "scales": log_scales + shrunk.log(),
        "opacities": (torch.log(-torch.expm1(clear)) - clear).to(log_scales.dtype),
        "offset": torch.einsum("nij,nj->ni", axes, local),
    }


@torch.no_grad()
def split(splats: Splats, optimizers: Optimizers, rows: Tensor, places: Tensor) -> None:
    """Split splats in two: one half stays in its row, the other takes one of `places`, or a new row at the end.

    Moments of both are zero. The table's tensors are replaced only if it grows.

    Args:
        splats: the table.
        optimizers: of each entry, by its name.
        rows: different rows, int64 [M].
        places: rows to be overwritten by the first of them, int64 [at most M], none of them in `rows`.
    """
    half = halves(splats, rows, torch.randint(0, 2, (len(rows), 3), device=rows.device) * 2.0 - 1.0)
    taken = len(places)

    changed, added = torch.cat([rows, places]), {}
    for name, parameter in splats.items():
        first = second = half[name] if name in half else parameter.data[rows]
        if name == "means":
            first, second = first + half["offset"], first - half["offset"]
        parameter.data[changed] = torch.cat([first, second[:taken]])
        added[name] = second[taken:]
        for value in optimizers[name].state.get(parameter, {}).values():
            if value.dim() > 0:
                value[changed] = 0.0
    if taken == len(rows):
        return

    def moments(_: str, old: Tensor) -> Tensor:
        return torch.cat([old, old.new_zeros(len(rows) - taken, *old.shape[1:])])

    _update_param_with_optimizer(
        lambda name, old: Parameter(torch.cat([old.detach(), added[name]])), moments, splats, optimizers
    )
