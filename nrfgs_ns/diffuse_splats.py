# SPDX-License-Identifier: Apache-2.0
"""Splats that lose their residual while a model trains, and get it back when they start to need it.

From a step on, every splat whose residual changes no training view by a given amount (`residuals.py`), or as many as
cost nothing on views that nothing was trained on, become diffuse: the part of its residual that all views see moves
into its base colour and base opacity, and the head is no longer evaluated for it. A diffuse splat's latent gets no
gradient, so that it could never come back by itself. So, some steps before each of the later looks, all splats have
their residual again, without the part that had moved, and train with it; then it is decided anew.

    step  start             + every - trial     + every           ...
          look, some off    all on, on trial    look, some off

After the last trial the training goes on with what was decided.

Nothing tells a field to be silent where the base and the geometry could say the same: what is learnt first by either is
learnt by both, and a look afterwards finds residuals that do much and are not needed. So, from the end of densification
until the last look, they can be made to cost something in the training's loss, their mean length over the visible
splats (`residual_cost` of the model; `capacity/charge.py`). By default it is 0.

What pays is measured as capacity "auto" measures it. Some training views are set aside until the last look. The splats
as they are have to be better on them, by more than the budget, than those without the residuals in question, after both
have settled on the other views (`capacity/settle.py`). Views that the residuals were fitted
to cannot tell: there, noise that they have learnt looks like something that the scene needs.

Which splats are diffuse, and what has moved, are two tables among densification's statistics, "diffuse" [N] and
"diffuse_shift" [N, 4]: they are split, pruned, saved and loaded with the splats. In a training, diffuse splats are the
table's last rows.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.optim import Optimizer

from nrfgs_ns.appearance.diffuse import DIFFUSE, SHIFT
from nrfgs_ns.appearance.reduce import Field, with_diffuse
from nrfgs_ns.capacity.report import add_to_report, read_report
from nrfgs_ns.capacity.settle import Lessons, settle
from nrfgs_ns.densification.rows import take_rows
from nrfgs_ns.errors import InputError
from nrfgs_ns.field_views import FieldViews
from nrfgs_ns.residuals import Residuals, look_over

SHARES = (0.25, 0.5, 0.65, 0.8, 0.9, 0.95, 0.97, 0.98, 0.99, 1.0)
"""Of the splats, in the order of what their residuals change: how many may be without one."""


class Look(NamedTuple):
    """A share of the splats that was tried."""

    share: float
    """of the splats, 0 to 1"""
    loss_db: float
    """what a field without their residuals lacks on the views set aside, both settled"""
    error_db: float
    """standard error of the loss over the views; 0 for a single view"""
    allowed: bool
    """whether that is within the budget"""


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
    """largest change, in 8-bit steps, that a diffuse splat's residual made in any training view; 0.5 is the one below
    which a splat by itself cannot be noticed. None: as many splats as the budget allows at each look, those that change
    the least of the training views first"""
    budget: float = 0.1
    """dB that diffuse splats may cost on the views set aside, right after a look; where no threshold is given. By the
    end of the training less is left of it (docs/necessity.md)"""
    views: int | None = None
    """training views, evenly spaced, that are set aside until the last look, to choose how many on; where no threshold
    is given. None: an eighth of all, at least 2 and at most 16"""
    settle: int = 100
    """steps in which the splats with and without some residuals get used to it before they are compared"""


class DiffuseSchedule:
    """What to do after which step.

    Args:
        config: with a start.
        data: the datamanager, with the training views and their images.
        optimizers: the training's, by group.
        folder: where the evidence goes (capacity.json); None for nowhere.

    Raises:
        InputError: an option is out of range.
    """

    stretched = False

    def __init__(self, config: DiffuseSplats, data, optimizers: Mapping[str, Optimizer], folder: Path | None = None):
        self.config, self.data, self.optimizers, self.folder = config, data, optimizers, folder
        self.in_order: Tensor | None = None
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
        if not config.budget >= 0:
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

    def tell(self, model, step: int, looks: list[Look]) -> None:
        """Write down how many splats are diffuse, and by which evidence."""
        diffuse = model.densification.state[DIFFUSE]
        look = {
            "step": step,
            "splats": len(diffuse),
            "diffuse": int(diffuse.sum()),
            "threshold": self.config.threshold,
            "budget_db": self.config.budget,
            "tried": [look._asdict() for look in looks],
        }
        earlier = [one for one in read_report(self.folder).get("looks", []) if one["step"] < step]
        add_to_report(self.folder, {"looks": [*earlier, look]})

    def after_step(self, model, step: int) -> None:
        """Look at the splats, or begin a trial, if it is time."""
        since = step - self.config.start
        if since < 0:
            return
        phase = since % self.config.every
        if phase == 0 and DIFFUSE not in model.densification.state:
            self.tell(model, step, make_diffuse(model, self.data, self.config, self.optimizers))
        elif phase == self.config.every - self.trial and step <= self.config.stop:
            give_back(model)
        self.keep_order(model)

    def keep_order(self, model) -> None:
        """Move diffuse splats to the table's end, if some have become diffuse or densification has put others there."""
        diffuse = model.densification.state.get(DIFFUSE)
        if diffuse is not self.in_order:  # another tensor whenever there are other rows
            put_diffuse_last(model, self.optimizers)
            self.in_order = model.densification.state.get(DIFFUSE)


@torch.no_grad()
def make_diffuse(model, data, config: DiffuseSplats, optimizers: Mapping[str, Optimizer]) -> list[Look]:
    """Find the splats that need no residual, and let their base have the mean of what the views saw.

    Args:
        model: an NrfgsModel, of whose splats none is diffuse.
        data: the datamanager; with views set aside, unless a threshold is given.
        config: how to find them.
        optimizers: the training's, by group.

    Returns:
        The shares that were tried; none where a threshold is given.
    """
    training = model.training
    model.eval()
    data.cached_train  # noqa: B018  (before the cameras: undistortion crops them while it loads the images)
    seen = look_over(model, data.train_dataset.cameras)
    looks: list[Look] = []
    if config.threshold is None:
        looks = share_that_pays(model, data, config, optimizers, seen)
        rows = seen.least(max((look.share for look in looks if look.allowed), default=0.0))[:, None]
        why = f"they cost {config.budget:g} dB or less on the views set aside"
    else:
        rows = seen.negligible(config.threshold)[:, None]
        why = f"their residual changes no training view by {config.threshold:g} 8-bit steps"
    model.train(training)
    tables = model.gauss_params["features_dc"], model.gauss_params["opacities"]
    shifts = []
    for table, mean in zip(tables, (seen.features_dc, seen.opacities), strict=True):
        shifts.append(torch.where(rows, mean - table, 0.0))
        table.add_(shifts[-1])
    model.densification.state |= {DIFFUSE: rows[:, 0], SHIFT: torch.cat(shifts, dim=1)}
    CONSOLE.print(f"Step {model.step}: {int(rows.sum()):,} of {len(rows):,} splats are diffuse: {why}.", soft_wrap=True)
    return looks


def share_that_pays(
    model, data, config: DiffuseSplats, optimizers: Mapping[str, Optimizer], seen: Residuals
) -> list[Look]:
    """Which of SHARES cost no more than the budget on the views set aside.

    The field with all residuals settles, and so does that without the residuals in question, on the same views in the
    same order. Found by halving: the loss grows with the share, but for noise.

    Args:
        as for `make_diffuse`; seen: the splats from the training views.
    """
    aside = FieldViews(model, [data.train_view(index) for index in data.views_aside], geometry=True)
    lessons = Lessons(data, config.settle)
    field = Field(model.head, {name: value.detach() for name, value in model.gauss_params.items()})

    def scores(some: Field) -> Tensor:
        settled = settle(model, some, lessons, config.settle, optimizers)
        return torch.tensor(aside.scores(settled.field), dtype=torch.float64)

    reference, looks = scores(field), []
    allowed, too_many = -1, len(SHARES)
    while too_many - allowed > 1:
        middle = (allowed + too_many) // 2 if looks else len(SHARES) - 1
        share = SHARES[middle]
        losses = reference - scores(with_diffuse(field, seen.least(share), seen.features_dc, seen.opacities))
        loss = float(losses.mean())
        error = float(losses.std()) / math.sqrt(len(losses)) if len(losses) > 1 else 0.0
        looks.append(Look(share, loss, error, loss <= config.budget))
        allowed, too_many = (middle, too_many) if looks[-1].allowed else (allowed, middle)
    return looks


def put_diffuse_last(model, optimizers: Mapping[str, Optimizer]) -> None:
    """Reorder the splats so that diffuse ones come last, each kind in the order that it had. Nothing is touched where
    they do already, or where none is known to be diffuse.

    Args:
        model: an NrfgsModel.
        optimizers: the training's, by group.
    """
    diffuse = model.densification.state.get(DIFFUSE)
    if diffuse is None or not (diffuse[:-1] & ~diffuse[1:]).any():
        return
    # A camera sees splats in the table's order, and the fused head works on blocks of neighbours: what it saves is the
    # network of blocks in which all are diffuse, of which there are next to none where both kinds are mixed.
    take_rows(model, optimizers, diffuse.to(torch.uint8).argsort(stable=True))


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
    model,
    data,
    devices: int,
    optimizers: Mapping[str, Optimizer] | None = None,
    folder: Path | None = None,
) -> DiffuseSchedule | None:
    """The schedule that a model's configuration asks for, or None.

    Args:
        model: an NrfgsModel.
        data: the datamanager.
        devices: over which the splats are spread.
        optimizers: the training's, by group.
        folder: where the evidence goes; None for nowhere.

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
    return DiffuseSchedule(config, data, optimizers, folder)
