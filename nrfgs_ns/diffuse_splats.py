# SPDX-License-Identifier: Apache-2.0
"""Splats that lose their residual while a model trains, and get it back when they start to need it.

From a step on, every splat whose residual changes no training view by a given amount (`residuals.py`), or by less than
pays on views that nothing was trained on, becomes diffuse: the part of its residual that all views see moves into its
base colour and base opacity, and the head is no longer evaluated for it. A diffuse splat's latent gets no gradient, so
that it could never come back by itself. So, some steps before each of the later looks, all splats have their residual
again, without the part that had moved, and train with it; then it is decided anew.

    step  start             + every - trial     + every           ...
          look, some off    all on, on trial    look, some off

After the last trial the training goes on with what was decided.

What pays is measured as capacity "auto" measures it. Some training views are set aside until the last look. The field
as it is has to be better on them, by more than the budget, than the field without the residuals in question: at once,
and after both have settled on the other views (`capacity/settle.py`). Views that the residuals were fitted to cannot
tell: there, noise that they have learnt looks like something that the scene needs.

Which splats are diffuse, and what has moved, are two tables among densification's statistics, "diffuse" [N] and
"diffuse_shift" [N, 4]: they are split, pruned, saved and loaded with the splats.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch.optim import Optimizer

from nrfgs_ns.appearance.diffuse import DIFFUSE, SHIFT
from nrfgs_ns.appearance.reduce import Field
from nrfgs_ns.capacity.settle import lesson_order, settle
from nrfgs_ns.errors import InputError
from nrfgs_ns.field_views import THRESHOLDS, FieldViews, dropped, largest_threshold
from nrfgs_ns.residuals import Residuals, look_over


@dataclass
class DiffuseSplats:
    """When splats whose residual never matters become diffuse."""

    start: int | None = None
    """first step after which they do. None: never"""
    every: int = 5000
    """steps between two looks at all splats"""
    stop: int = 25_000
    """last step after which a trial may begin"""
    trial: int | None = None
    """steps before each look but the first in which all splats have their residual. None: one for each training view"""
    threshold: float | None = None
    """largest change, in 8-bit steps, that a diffuse splat's residual made in any training view. None: the largest of
    0.25, 0.5, 1, ... 8 and infinity that the budget allows at each look; 0.5 is the one below which a splat by itself
    cannot be noticed"""
    budget: float = 0.05
    """dB that diffuse splats may cost on the views set aside; where no threshold is given"""
    views: int | None = None
    """training views, evenly spaced, that are set aside until the last look, to choose a threshold on; where none is
    given. None: an eighth of all, at least 2 and at most 16"""
    settle: int = 100
    """steps in which the field with and without some residuals gets used to it before they are compared"""


class DiffuseSchedule:
    """What to do after which step.

    Args:
        config: with a start.
        data: the datamanager, with the training views and their images.
        optimizers: the training's, by group.

    Raises:
        InputError: an option is out of range.
    """

    def __init__(self, config: DiffuseSplats, data, optimizers: Mapping[str, Optimizer]):
        self.config, self.data, self.optimizers = config, data, optimizers
        self.option = "pipeline.model.diffuse without a threshold"
        self.trial = len(data.train_dataset) if config.trial is None else config.trial
        prefix = "pipeline.model.diffuse"
        if config.start < 0:
            raise InputError(f"{prefix}.start is {config.start}; it must be zero or positive.")
        if not 1 <= self.trial < config.every:
            raise InputError(
                f"{prefix}.trial is {self.trial} steps of {prefix}.every {config.every}; a trial must be at least one "
                f"step and shorter than that. Set --{prefix}.every or --{prefix}.trial."
            )
        if config.threshold is not None and not config.threshold > 0:
            raise InputError(f"{prefix}.threshold is {config.threshold}; it must be positive.")
        if config.budget < 0:
            raise InputError(f"{prefix}.budget is {config.budget}; it must be zero or positive.")
        for name in ("views", "settle"):
            value = getattr(config, name)
            if value is not None and value < 1:
                raise InputError(f"{prefix}.{name} is {value}; it must be at least 1.")

    @property
    def last_decision(self) -> int:
        """The step after which splats are looked at for the last time."""
        config = self.config
        return config.start + max((config.stop + self.trial - config.start) // config.every, 0) * config.every

    def views_wanted(self) -> int | None:
        return self.config.views

    def is_done(self, step: int) -> bool:
        return step >= self.last_decision

    def after_step(self, model, step: int) -> None:
        """Look at the splats, or begin a trial, if it is time."""
        since = step - self.config.start
        if since < 0:
            return
        phase = since % self.config.every
        if phase == 0 and DIFFUSE not in model.densification.state:
            make_diffuse(model, self.data, self.config, self.optimizers)
        elif phase == self.config.every - self.trial and step <= self.config.stop:
            give_back(model)


@torch.no_grad()
def make_diffuse(model, data, config: DiffuseSplats, optimizers: Mapping[str, Optimizer]) -> None:
    """Find the splats that need no residual, and let their base have the mean of what the views saw.

    Args:
        model: an NrfgsModel, of whose splats none is diffuse.
        data: the datamanager; with views set aside, unless a threshold is given.
        config: how to find them.
        optimizers: the training's, by group.
    """
    training = model.training
    model.eval()
    data.cached_train  # noqa: B018  (before the cameras: undistortion crops them while it loads the images)
    seen = look_over(model, data.train_dataset.cameras)
    threshold = config.threshold
    if threshold is None:
        threshold = threshold_that_pays(model, data, config, optimizers, seen)
    model.train(training)
    rows = seen.negligible(threshold)[:, None]
    tables = model.gauss_params["features_dc"], model.gauss_params["opacities"]
    shifts = []
    for table, mean in zip(tables, (seen.features_dc, seen.opacities), strict=True):
        shifts.append(torch.where(rows, mean - table, 0.0))
        table.add_(shifts[-1])
    model.densification.state |= {DIFFUSE: rows[:, 0], SHIFT: torch.cat(shifts, dim=1)}
    CONSOLE.print(
        f"Step {model.step}: {int(rows.sum()):,} of {len(rows):,} splats are diffuse: their residual changes no "
        f"training view by {threshold:g} 8-bit steps."
        if threshold < math.inf
        else f"Step {model.step}: all {len(rows):,} splats are diffuse: no residual pays.",
        soft_wrap=True,
    )


def threshold_that_pays(
    model, data, config: DiffuseSplats, optimizers: Mapping[str, Optimizer], seen: Residuals
) -> float:
    """The largest of THRESHOLDS that costs no more than the budget on the views set aside; 0 if none does.

    What costs no more at once, before anything settles, is found without noise: two fields that settle differ a little
    by chance. Of the larger thresholds, those are allowed that cost no more once both fields have settled.

    Args:
        as for `make_diffuse`; seen: the splats from the training views.
    """
    aside = FieldViews(model, [data.train_view(index) for index in data.views_aside])
    lessons = [data.train_view(index) for index in lesson_order(data, config.settle)]
    field = Field(model.head, dict(model.gauss_params.items()))

    def settled(some: Field) -> Field:
        return settle(model, some, lessons, config.settle, optimizers).field

    at_once = largest_threshold(field, seen, aside, aside.psnr(field) - config.budget)
    if at_once == THRESHOLDS[-1]:
        return at_once
    lowest = aside.psnr(settled(field)) - config.budget
    if aside.psnr(settled(dropped(field, seen, THRESHOLDS[-1]))) >= lowest:
        return THRESHOLDS[-1]
    tried = [at_once, *(threshold for threshold in THRESHOLDS[:-1] if threshold > at_once)]
    allowed, too_many = 0, len(tried)
    while too_many - allowed > 1:  # the loss grows with the threshold, but for noise: halve the interval
        middle = (allowed + too_many) // 2
        enough = aside.psnr(settled(dropped(field, seen, tried[middle]))) >= lowest
        allowed, too_many = (middle, too_many) if enough else (allowed, middle)
    return tried[allowed]


@torch.no_grad()
def give_back(model) -> None:
    """All splats have their residual again, and their base is without what had moved there."""
    state = model.densification.state
    state.pop(DIFFUSE, None)
    shift = state.pop(SHIFT, None)
    if shift is not None:
        model.gauss_params["features_dc"].sub_(shift[:, :3])
        model.gauss_params["opacities"].sub_(shift[:, 3:])


def schedule_for(
    model, data, devices: int, optimizers: Mapping[str, Optimizer] | None = None
) -> DiffuseSchedule | None:
    """The schedule that a model's configuration asks for, or None.

    Args:
        model: an NrfgsModel.
        data: the datamanager.
        devices: over which the splats are spread.
        optimizers: the training's, by group.

    Raises:
        InputError: it cannot be followed by this model.
    """
    config: DiffuseSplats = model.config.diffuse
    if config.start is None:
        return None
    option = f"pipeline.model.diffuse.start is {config.start}"
    if not model.head.knows_diffuse:
        raise InputError(f"{option}, but the {model.head.name!r} head has no residual to leave out. Leave it unset.")
    if model.config.densification == "mcmc":
        raise InputError(
            f"{option}, but densification 'mcmc' moves splats onto others without their statistics. Use "
            "--pipeline.model.densification splatfacto or original, or leave it unset."
        )
    if devices > 1:
        raise InputError(f"{option}, but the splats are spread over {devices} devices. Use one, or leave it unset.")
    return DiffuseSchedule(config, data, optimizers)
