# SPDX-License-Identifier: Apache-2.0
"""Splats that lose their residual while a model trains, and get it back when they start to need it.

From a step on, every splat whose residual changes no training view by a given amount (`residuals.py`), or by as much as
some training views together can do without (`field_views.py`), becomes diffuse:
the part of its residual that all views see moves into its base colour and base opacity, and the head is no longer
evaluated for it. A diffuse splat's latent gets no gradient, so that it could never come back by itself. So, some steps
before each of the later looks, all splats have their residual again, without the part that had moved, and train with
it; then it is decided anew.

    step  start             + every - trial     + every           ...
          look, some off    all on, on trial    look, some off

After the last trial the training goes on with what was decided.

Which splats are diffuse, and what has moved, are two tables among densification's statistics, "diffuse" [N] and
"diffuse_shift" [N, 4]: they are split, pruned, saved and loaded with the splats.
"""

from dataclasses import dataclass

import torch

from nrfgs_ns.appearance.diffuse import DIFFUSE, SHIFT
from nrfgs_ns.appearance.reduce import Field
from nrfgs_ns.errors import InputError
from nrfgs_ns.field_views import FieldViews, largest_threshold
from nrfgs_ns.residuals import look_over


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
    """dB that a look may cost on some training views, before the model trains on; where no threshold is given"""
    views: int = 8
    """training views, evenly spaced, on which a threshold is chosen"""


class DiffuseSchedule:
    """What to do after which step.

    Args:
        config: with a start.
        data: the datamanager, with the training views and their images.

    Raises:
        InputError: an option is out of range.
    """

    def __init__(self, config: DiffuseSplats, data):
        self.config, self.data = config, data
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
        if config.views < 1:
            raise InputError(f"{prefix}.views is {config.views}; it must be at least 1.")

    def after_step(self, model, step: int) -> None:
        """Look at the splats, or begin a trial, if it is time."""
        since = step - self.config.start
        if since < 0:
            return
        phase = since % self.config.every
        if phase == 0 and DIFFUSE not in model.densification.state:
            make_diffuse(model, self.data, self.config)
        elif phase == self.config.every - self.trial and step <= self.config.stop:
            give_back(model)


@torch.no_grad()
def make_diffuse(model, data, config: DiffuseSplats) -> None:
    """Find the splats that need no residual, and let their base have the mean of what the views saw.

    Args:
        model: an NrfgsModel, of whose splats none is diffuse.
        data: the datamanager.
        config: how to find them.
    """
    training = model.training
    model.eval()
    images = data.cached_train  # before the cameras: undistortion crops them while it loads the images
    cameras = data.train_dataset.cameras
    seen = look_over(model, cameras)
    threshold = config.threshold
    if threshold is None:
        chosen = sorted({i * len(images) // config.views for i in range(config.views)})
        views = FieldViews(model, [(cameras[i : i + 1].to(model.device), images[i]) for i in chosen])
        field = Field(model.head, dict(model.gauss_params.items()))
        threshold = largest_threshold(field, seen, views, views.psnr(field) - config.budget)
    model.train(training)
    rows = seen.negligible(threshold)[:, None]
    tables = model.gauss_params["features_dc"], model.gauss_params["opacities"]
    shifts = []
    for table, mean in zip(tables, (seen.features_dc, seen.opacities), strict=True):
        shifts.append(torch.where(rows, mean - table, 0.0))
        table.add_(shifts[-1])
    model.densification.state |= {DIFFUSE: rows[:, 0], SHIFT: torch.cat(shifts, dim=1)}


@torch.no_grad()
def give_back(model) -> None:
    """All splats have their residual again, and their base is without what had moved there."""
    state = model.densification.state
    state.pop(DIFFUSE, None)
    shift = state.pop(SHIFT, None)
    if shift is not None:
        model.gauss_params["features_dc"].sub_(shift[:, :3])
        model.gauss_params["opacities"].sub_(shift[:, 3:])


def schedule_for(model, data, devices: int) -> DiffuseSchedule | None:
    """The schedule that a model's configuration asks for, or None.

    Args:
        model: an NrfgsModel.
        data: the datamanager.
        devices: over which the splats are spread.

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
    return DiffuseSchedule(config, data)
