# SPDX-License-Identifier: Apache-2.0
"""Growth where the error is, to a number of splats that the capture decides.

The recipe that brush (Arthur Brussee, Apache-2.0, `crates/brush-train`) and LichtFeld-Studio's default have in common:

- A splat's *error* is the sum over pixels of |dL/dmean2d|, with lengths in images, the largest over the views of a
  window. It does not depend on the size of the images, the number of views or the unit of the scene.
- At each refinement a share of the splats whose error is above a threshold is split, drawn in proportion to the error.
- Splats that no view of the last two windows shows at `prune_opacity` or more are dead. Each is replaced by half of a
  live one, drawn in proportion to its opacity.
- Opacities are never reset. Each refinement takes a little from all of them, which the loss gives back where it counts.
- Noise moves the means of splats that are all but invisible.

Which opacity a view shows decides (docs/opacity.md): the stored one with the largest change by a view lately.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from gsplat.strategy.ops import _update_param_with_optimizer
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor
from torch.nn import Parameter

from nrfgs_ns.densification.mcmc import CHANGE_BEFORE
from nrfgs_ns.densification.relocation import Optimizers, Splats
from nrfgs_ns.densification.strategy import (
    CHANGE,
    UNSEEN,
    Densification,
    DensificationConfig,
    OpacitySeen,
    Shown,
    change_of,
    seen_with,
)

ERROR = "error"
"""Name in `state`: the largest error of each splat in a view of this window, [N]."""
WIDTH = "width"
"""Name in `state`: the largest radius of each splat in this window, in longer sides of the image, [N]; 0: not seen."""
FADING = 150
"""Noise is multiplied by (1 - opacity) to this power."""
LAYOUT = 30_000
"""Steps of the training that the options' steps belong to."""
WIDEST = 0.75
"""Radius of a wide splat: three standard deviations, in longer sides of the image."""


@dataclass
class ErrorGuided(DensificationConfig):
    """Growth guided by the error, as in brush and LichtFeld-Studio, up to a cap."""

    name: ClassVar[str] = "error-guided"
    steps: ClassVar[tuple[str, ...]] = (*DensificationConfig.steps, "grow_until", "stop_at")
    opacity_seen: OpacitySeen = "peak"
    """opacity by which splats are dead (docs/opacity.md). base: stored. peak: largest shown in two windows"""
    refine_every: int = 200
    """steps between refinements; the views of these are a window"""
    threshold: float = 0.0025
    """error above which a splat may be split: the smaller, the more splats and detail"""
    most_splats: int = 2_000_000
    """upper bound; growth ends earlier by itself"""
    share: float = 0.25
    """share of the splats above the threshold that each refinement splits"""
    grow_until: int = 15_000
    """step after which splats are only replaced"""
    stop_at: int = 25_000
    """step after which nothing changes any more"""
    decay: float = 0.004
    """taken from each opacity at a refinement, falling linearly to 0 over the training"""
    prune_opacity: float = 1 / 255
    """splats that no view of two windows shows above this are dead; the rasterizer draws nothing below 1/255"""
    wide: Literal["keep", "split", "replace"] = "keep"
    """what becomes of splats of a radius above three quarters of the image"""
    noise: float = 6.0
    """noise on the means of invisible splats, in learning rates of the means"""

    def check(self) -> None:
        super().check()
        self.require(0 < self.share <= 1, "share", "above 0 and at most 1")
        self.require(self.most_splats >= 1, "most_splats", "at least 1")
        self.require(self.wide in ("keep", "split", "replace"), "wide", "keep, split or replace")

    def share_of(self, rank: int, devices: int) -> "ErrorGuided":
        return replace(self, most_splats=len(range(rank, self.most_splats, devices)))

    def build(self, num_train_images: int, scene_unit: float) -> "ErrorGuidedDensification":
        return ErrorGuidedDensification(self)


class ErrorGuidedDensification(Densification):
    """Splits by error, replacement by opacity, decay of opacity. Which opacity is seen decides what is dead; noise
    always goes by the shown one."""

    name = ErrorGuided.name
    takes_all_rows = True

    def __init__(self, config: ErrorGuided):
        super().__init__(config.opacity_seen)
        self.state |= {ERROR: None, WIDTH: None}
        if config.opacity_seen == "peak":
            self.state[CHANGE_BEFORE] = None
        self.config = config
        self.reschedule(round)

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        config = self.config
        self.start, self.grow_until = step_at(config.warmup_length), step_at(config.grow_until)
        self.stop, self.end = step_at(config.stop_at), step_at(LAYOUT)

    def needs_absgrad(self, step: int) -> bool:
        return step < self.grow_until

    def rests_at(self, step: int) -> bool:
        return step >= self.grow_until

    # What a step shows.

    def pre_backward(self, step: int, info: dict[str, Any], opacities: Tensor, logits: Tensor) -> None:
        """See `Densification`. What a view shows is left in `info`: a recorded step fills it anew each time."""
        rows, shown = info["gaussian_ids"], opacities.detach()
        self.shown = Shown(rows, opacities, info.get("n_cameras", 1))
        info["shown"] = shown
        if self.opacity_seen == "peak":
            # Rows first, then the sigmoid, as heads do: in the other order the last bit may differ.
            stored = torch.sigmoid(logits.detach().index_select(0, rows)).squeeze(-1)
            change = change_of(stored, shown.to(stored.dtype))
            info["change"] = torch.where(info["radii"] > 0, change, UNSEEN)
        if step < self.grow_until:
            info["means2d"].retain_grad()

    @torch.no_grad()
    def post_backward(self, step, info, splats, optimizers) -> None:
        self.shown = None
        if step >= self.stop:
            return
        self._take_statistics(step, info, len(splats["means"]))
        if step > self.start and step % self.config.refine_every == 0:
            self._refine(step, splats, optimizers)
            self._begin_another_window()
        if self.config.noise > 0:
            self._shake(info, splats, optimizers)

    def _take_statistics(self, step: int, info: Mapping[str, Any], count: int) -> None:
        """Let the window's maxima be at least the step's."""
        rows, radii = info["gaussian_ids"], info["radii"]
        for name in self.state.keys() & {ERROR, WIDTH, CHANGE, CHANGE_BEFORE}:
            if self.state[name] is None:
                empty = UNSEEN if name in (CHANGE, CHANGE_BEFORE) else 0.0
                self.state[name] = torch.full((count,), empty, device=radii.device)
        values = {WIDTH: radii / float(max(info["width"], info["height"]))}
        if self.opacity_seen == "peak":
            values[CHANGE] = info["change"]
        if step < self.grow_until:
            x, y = info["means2d"].absgrad.unbind(dim=-1)
            cameras = info["n_cameras"]  # over which the loss is a mean
            values[ERROR] = torch.hypot(x * (info["width"] * cameras), y * (info["height"] * cameras)) * (radii > 0)
        for name, value in values.items():
            if _is_whole(info, count):
                torch.maximum(self.state[name], value, out=self.state[name])
            else:
                self.state[name].scatter_reduce_(0, rows, value, "amax")

    def _begin_another_window(self) -> None:
        if CHANGE in self.state:
            self.state[CHANGE_BEFORE] = self.state[CHANGE]
            self.state[CHANGE] = torch.full_like(self.state[CHANGE], UNSEEN)
        self.state[ERROR].zero_()
        self.state[WIDTH].zero_()

    def seen_opacity(self, opacities: Tensor) -> Tensor:
        """Stored opacities [N] with the largest change by a view of this window or the one before."""
        stored = torch.sigmoid(opacities.detach().flatten())
        changes = [self.state[name] for name in (CHANGE, CHANGE_BEFORE) if self.state.get(name) is not None]
        return seen_with(stored, torch.stack(changes).amax(dim=0)) if changes else stored

    # What a refinement does.

    def _refine(self, step: int, splats: Splats, optimizers: Optimizers) -> None:
        """Replace the dead, split where the error is, and take a little from all opacities."""
        config, state, count = self.config, self.state, len(splats["means"])
        opacities, wide = self.seen_opacity(splats["opacities"]), state[WIDTH] > WIDEST
        dead = opacities < config.prune_opacity
        if config.wide == "replace":
            dead |= wide
        parents = draw((opacities * (state[WIDTH] > 0)).masked_fill(dead, 0.0), int(dead.sum()))
        places = dead.nonzero()[:, 0][: len(parents)]
        grown = parents[:0]
        if step < self.grow_until:
            weights = (state[ERROR] * (state[ERROR] > config.threshold)).masked_fill(dead, 0.0)
            wanted = round(config.share * int((weights > 0).sum())) - len(places)
            if config.wide == "split":  # before any other
                weights = weights.masked_fill(wide & ~dead, math.inf)
                wanted = max(wanted, int(wide.sum()))
            grown = draw(weights.index_fill(0, parents, 0.0), min(wanted, config.most_splats - count))
        split(splats, optimizers, torch.cat([parents, grown]), places)
        source = torch.arange(count, device=dead.device).index_copy(0, places, parents)
        source = torch.cat([source, grown])
        for name in state.keys() & {ERROR, WIDTH, CHANGE, CHANGE_BEFORE}:
            state[name] = state[name][source]
        taken = config.decay * (1 - min(step / self.end, 1.0))
        stored = torch.sigmoid(splats["opacities"].detach())
        eps = torch.finfo(stored.dtype).eps
        splats["opacities"].data.copy_(torch.logit((stored - taken).clamp(1e-6, 1 - eps)))
        if self.verbose:
            print(
                f"Step {step}: {len(places)} GSs replaced, {len(grown)} split. Now having {len(splats['means'])} GSs."
            )

    def _shake(self, info: Mapping[str, Any], splats: Splats, optimizers: Optimizers) -> None:
        """Move the means of nearly invisible splats that a view has shown, the more the fainter."""
        lr = float(optimizers["means"].param_groups[0]["lr"])
        rows, means = info["gaussian_ids"], splats["means"]
        faint = torch.where(info["radii"] > 0, (1.0 - info["shown"]).clamp_min(0.0) ** FADING, 0.0)
        noise = torch.randn(len(rows), 3, device=means.device) * (faint * (self.config.noise * lr))[:, None]
        if _is_whole(info, len(means)):
            means.add_(noise)
        else:
            means.index_add_(0, rows, noise)


def _is_whole(info: Mapping[str, Any], count: int) -> bool:
    """Whether a step's rows are the table's, in its order."""
    return info["n_cameras"] == 1 and len(info["gaussian_ids"]) == count


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
    """What each of two splats has that take the place of one: variances as before along each axis, the longest axis
    shortened most, and together about as opaque.

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
    signs = torch.randint(0, 2, (len(rows), 3), device=rows.device) * 2.0 - 1.0
    half = halves(splats, rows, signs)
    taken, new = len(places), len(rows) - len(places)

    def values(name: str, old: Tensor, sign: float) -> Tensor:
        if name == "means":
            return old[rows] + sign * half["offset"]
        return half[name] if name in half else old[rows]

    def overwrite(name: str, table: Tensor) -> None:
        first, second = values(name, table, 1.0), values(name, table, -1.0)
        table[rows] = first
        table[places] = second[:taken]
        return second[taken:]

    def clear(table: Tensor) -> None:
        table[rows] = 0.0
        table[places] = 0.0

    if new == 0:
        for name, parameter in splats.items():
            overwrite(name, parameter.data)
            for value in optimizers[name].state.get(parameter, {}).values():
                if value.dim() > 0:
                    clear(value)
        return

    def grown(name: str, old: Tensor) -> Parameter:
        table = old.detach().clone()
        return Parameter(torch.cat([table, overwrite(name, table)]))

    def moments(_: str, old: Tensor) -> Tensor:
        table = old.clone()
        clear(table)
        return torch.cat([table, old.new_zeros(new, *old.shape[1:])])

    _update_param_with_optimizer(grown, moments, splats, optimizers)
