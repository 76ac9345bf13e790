# SPDX-License-Identifier: Apache-2.0
"""Let a field that has lost a part get used to it.

A trained part carries more than is needed of it: what all views see alike, and what other parts could say as well. What
a part is worth is told by the difference between a field with it and one without it after both have learnt a little
more from the same views in the same order. Geometry learns with them: what a part does for a splat that has the wrong
place or shape, place and shape can learn to do.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.reduce import Field, build
from nrfgs_ns.harmonics_fit import OPAQUE, contributions

BASE = ("means", "scales", "quats", "features_dc", "opacities")
"""Per-splat tables that settle with the shared weights and the latents."""
FIELD = ("field", "latents")
"""Optimiser groups of what a smaller field has in other shapes."""


class Settled(NamedTuple):
    """A field that has learnt a little more, and the state of the Adams that taught it."""

    field: Field
    moments: dict[str, dict[Tensor, dict[str, Any]]]
    """Adam's state by optimiser group ("field", or the table's name) and parameter"""


def lesson_order(data, steps: int) -> list[int]:
    """The training views on which fields settle, none of them set aside: at most `steps`, evenly spaced, shuffled.

    The order is the same in each training and leaves the training's own generators alone.
    """
    aside = set(data.views_aside)
    others = [index for index in range(len(data.train_dataset)) if index not in aside]
    count = min(steps, len(others))
    chosen = [others[i * len(others) // count] for i in range(count)]
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    return [chosen[i] for i in order.tolist()]


def settle(
    model,
    field: Field,
    views: list,
    steps: int,
    optimizers: Mapping[str, torch.optim.Optimizer],
    fresh: tuple[str, ...] = (),
) -> Settled:
    """Train a copy of a field on some views; the model's own numbers stay.

    What comes of it is the mean of all numbers over the last half of the steps (Polyak and Juditsky, SIAM Journal on
    Control and Optimization 30, 1992): at a training's learning rates the last step of two fields differs by chance.

    Args:
        model: an NrfgsModel. It renders as in training, at the training's resolution.
        field: what starts; it is left as it is.
        views: pairs of a camera and its batch, taken in turn.
        steps: how many.
        optimizers: the training's, whose current learning rates and constants count.
        fresh: groups whose Adam starts anew. That of the others goes on from the training's state.
    """
    tables = (*BASE, "latents")
    weights = dict(field.head.state_dict())
    head = build(field.head.config, {name: value.clone() for name, value in weights.items()}, field.head.scene_unit)
    head.requires_grad_(True)
    splats = {name: value.detach() for name, value in field.splats.items()}
    for name in tables:
        splats[name] = splats[name].clone().requires_grad_(True)
    groups = {"field": list(head.parameters()), **{name: [splats[name]] for name in tables}}
    adams = {name: _adam(parameters, optimizers[name], name not in fresh) for name, parameters in groups.items()}
    learning = [parameter for group in groups.values() for parameter in group]
    means = [torch.zeros_like(parameter) for parameter in learning]
    last_half = steps - steps // 2
    was_training = model.training
    model.train()
    for step in range(steps):
        camera, batch = views[step % len(views)]
        with torch.enable_grad():
            view = model.look(camera, splats)
            outputs, _ = model.paint(view, head(splats, view.visible, view.center))
            model._correct_colors(outputs, camera)
            loss = model.photometric_loss(outputs, batch)
        for adam in adams.values():
            adam.zero_grad(set_to_none=True)
        loss.backward()
        for adam in adams.values():
            adam.step()
        if step >= steps // 2:
            for mean, parameter in zip(means, learning, strict=True):
                mean.add_(parameter.detach(), alpha=1.0 / last_half)
    with torch.no_grad():
        for mean, parameter in zip(means, learning, strict=True):
            parameter.copy_(mean)
    model.train(was_training)
    moments = {name: dict(adam.state) for name, adam in adams.items()}
    return Settled(Field(head, splats), moments)


def _adam(parameters: list[Tensor], like: torch.optim.Optimizer, goes_on: bool) -> torch.optim.Adam:
    group = like.param_groups[0]
    adam = torch.optim.Adam(parameters, lr=float(group["lr"]), betas=group["betas"], eps=group["eps"])
    for parameter, old in zip(parameters, group["params"], strict=True) if goes_on else ():
        if old in like.state:
            adam.state[parameter] = {name: value.clone() for name, value in like.state[old].items()}
            adam.state[parameter]["step"] = adam.state[parameter]["step"].cpu()  # where one that is not fused keeps it
    return adam


@torch.no_grad()
def keep_the_mean(model, field: Field, smaller: Field, views: list) -> Field:
    """A smaller field, whose splats' base has what they have lost of their mean appearance over some views.

    With y_v a splat's colour in view v, y'_v that of the smaller field and w_v its contribution, the base colour moves
    by sum w (y - y') / sum w; where the smaller field has no opacity residual and the other one has, the base opacity
    becomes the mean of the opacities.

    Args:
        model: an NrfgsModel in evaluation mode.
        field: with the part.
        smaller: without it.
        views: pairs of a camera and its batch.
    """
    count = len(field.splats["means"])
    sums = torch.zeros(count, 5, dtype=torch.float64, device=field.splats["means"].device)  # w, w (y - y'), w a
    for camera, _ in views:
        view = model.look(camera)
        whole = field.head(field.splats, view.visible, view.center)
        less = smaller.head(smaller.splats, view.visible, view.center)
        share = contributions(view.projection, whole.opacities).clamp_min(0.0)[:, None]
        columns = torch.cat([torch.ones_like(share), whole.colors - less.colors, whole.opacities[:, None]], dim=1)
        sums.index_add_(0, view.visible, (share * columns).double())
    mean = sums[:, 1:] / sums[:, :1].clamp_min(torch.finfo(torch.float64).tiny)
    splats = dict(smaller.splats)
    splats["features_dc"] = splats["features_dc"] + (mean[:, :3] / SH_C0).float()
    if field.head.config.opacity_residual and not smaller.head.config.opacity_residual:
        logits = torch.logit(mean[:, 3:].clamp(1.0 - OPAQUE, OPAQUE)).float()
        splats["opacities"] = torch.where(sums[:, :1] > 0, logits, splats["opacities"])
    return Field(smaller.head, splats)
