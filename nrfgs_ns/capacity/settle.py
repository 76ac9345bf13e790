# SPDX-License-Identifier: Apache-2.0
"""Let a field that has lost a part get used to it.

A trained part carries more than is needed of it: what all views see alike, and what other parts could say as well. What
a part is worth is told by the difference between a field with it and one without it after both have learnt a little
more from the same views in the same order. Geometry learns with them: what a part does for a splat that has the wrong
place or shape, place and shape can learn to do. How much is a little is not known beforehand: a field that has grown up
with a part needs long to learn to do without, the longer the fewer views there are. So settling can go on.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.nrf import NeuralResidualField
from nrfgs_ns.appearance.reduce import Field, build
from nrfgs_ns.harmonics_fit import OPAQUE, contributions

BASE = ("means", "scales", "quats", "features_dc", "opacities")
"""Per-splat tables that settle with the shared weights and the latents."""
TABLES = (*BASE, "latents")
"""All that settle."""
FIELD = ("field", "latents")
"""Optimiser groups of what a smaller field has in other shapes."""


class Settled(NamedTuple):
    """A field that has learnt a little more, and the state of the Adams that taught it."""

    field: Field
    moments: dict[str, dict[Tensor, dict[str, Any]]]
    """Adam's state by optimiser group ("field", or the table's name) and parameter. It is not a copy: if the settling
    goes on, it does, too"""
    steps: int
    """in which it has settled"""


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


class Lessons:
    """The training views on which fields settle, in their order: pairs of a camera and its batch.

    Each is fetched when its turn comes: in one go, the photographs of a large data set would not fit on the device.
    """

    def __init__(self, data, steps: int):
        self.data, self.order = data, lesson_order(data, steps)

    def __len__(self) -> int:
        return len(self.order)

    def __getitem__(self, position: int) -> tuple[Any, dict[str, Any]]:
        return self.data.train_view(self.order[position])


class Settling:
    """Trains a copy of a field on some views, in rounds; the model's own numbers stay, as do the random generators.

    The first round has as many steps as asked for, and each further one as many as all before it, so that the steps
    double. What comes of a round is the mean of all numbers over the last half of the steps so far (Polyak and
    Juditsky, SIAM Journal on Control and Optimization 30, 1992): at a training's learning rates the last step of two
    fields differs by chance. It is what as many steps at one go would have given; the learning goes on from the last
    step, not from the mean.

    Args:
        model: an NrfgsModel. It renders as in training, at the training's resolution.
        field: what starts; it is left as it is.
        views: pairs of a camera and its batch, taken in turn.
        steps: of the first round.
        optimizers: the training's, whose current learning rates and constants count.
        fresh: groups whose Adam starts anew. That of the others goes on from the training's state.
    """

    def __init__(
        self,
        model,
        field: Field,
        views: list,
        steps: int,
        optimizers: Mapping[str, torch.optim.Optimizer],
        fresh: tuple[str, ...] = (),
    ):
        self.model, self.views = model, views
        self.first, self.steps = steps, 0
        self.head = _copy(field.head)
        self.splats = {name: value.detach() for name, value in field.splats.items()}
        for name in TABLES:
            self.splats[name] = self.splats[name].clone().requires_grad_(True)
        groups = _groups(self.head, self.splats)
        self.adams = {name: _adam(group, optimizers[name], name not in fresh) for name, group in groups.items()}

    def advance(self) -> Settled:
        """One more round.

        Returns:
            The mean over its half of the steps so far, in tensors of its own, with Adam's state after the last step.
        """
        until = 2 * self.steps or self.first
        learning = _groups(self.head, self.splats)
        means = {name: [torch.zeros_like(parameter) for parameter in group] for name, group in learning.items()}
        counted = until - until // 2
        device, was_training = self.model.device, self.model.training
        self.model.train()
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            for step in range(self.steps, until):
                torch.manual_seed(step)  # backgrounds are random by default: fields to be compared see the same ones
                self._learn(*self.views[step % len(self.views)])
                for name, group in learning.items() if step >= until // 2 else ():
                    for mean, parameter in zip(means[name], group, strict=True):
                        mean.add_(parameter.detach(), alpha=1.0 / counted)
        self.model.train(was_training)
        self.steps = until
        return self._settled(means)

    def _learn(self, camera, batch: dict[str, Any]) -> None:
        """One step on one view."""
        with torch.enable_grad():
            view = self.model.look(camera, self.splats)
            outputs, _ = self.model.paint(view, self.head(self.splats, view.visible, view.center))
            self.model._correct_colors(outputs, camera)
            loss = self.model.photometric_loss(outputs, batch)
        # Of nothing else: poses and bilateral grids have the training's gradients.
        loss.backward(inputs=[one for adam in self.adams.values() for one in adam.param_groups[0]["params"]])
        for adam in self.adams.values():
            adam.step()
            adam.zero_grad(set_to_none=True)  # between rounds none need memory

    @torch.no_grad()
    def _settled(self, means: dict[str, list[Tensor]]) -> Settled:
        """A field with these numbers, by group."""
        head = _copy(self.head)
        for parameter, mean in zip(head.parameters(), means["field"], strict=True):
            parameter.copy_(mean)
        splats = {**self.splats, **{name: means[name][0] for name in TABLES}}
        learnt, moments = _groups(self.head, self.splats), {}
        for name, group in _groups(head, splats).items():
            state = self.adams[name].state
            pairs = zip(group, learnt[name], strict=True)
            moments[name] = {mean: state[parameter] for mean, parameter in pairs if parameter in state}
        return Settled(Field(head, splats), moments, self.steps)


def settle(
    model,
    field: Field,
    views: list,
    steps: int,
    optimizers: Mapping[str, torch.optim.Optimizer],
    fresh: tuple[str, ...] = (),
) -> Settled:
    """A field that has settled in one round.

    Args:
        as for `Settling`.
    """
    return Settling(model, field, views, steps, optimizers, fresh).advance()


def _copy(head: NeuralResidualField) -> NeuralResidualField:
    weights = {name: value.clone() for name, value in head.state_dict().items()}
    return build(head.config, weights, head.scene_unit).requires_grad_(True)


def _groups(head: NeuralResidualField, splats: Mapping[str, Tensor]) -> dict[str, list[Tensor]]:
    """What learns, by optimiser group."""
    return {"field": list(head.parameters()), **{name: [splats[name]] for name in TABLES}}


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
