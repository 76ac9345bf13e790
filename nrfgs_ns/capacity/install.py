# SPDX-License-Identifier: Apache-2.0
"""A smaller field takes the place of a model's, in training and when a checkpoint is loaded."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch.nn import Parameter

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.capacity.settle import BASE, Settled

CHANGED = ("latent_dim", "num_bands", "opacity_residual", "use_distance")
"""Fields of NrfConfig that tell a smaller field from the whole one."""


def head_changes(config: NrfConfig) -> dict[str, Any]:
    """What a checkpoint must say of a smaller field, so that it can be built again."""
    return {name: getattr(config, name) for name in CHANGED}


@torch.no_grad()
def install(model, optimizers, settled: Settled) -> None:
    """Train on with a smaller field.

    The splats' base, geometry included, keeps its place and Adam's state: what it is has not changed. Shared weights
    and latents are other numbers than before, in other coordinates; the old state says nothing of them. They go on with
    the state of the Adams that have just taught them.

    Args:
        model: an NrfgsModel in training.
        optimizers: the training's LeanOptimizers.
        settled: the field; its head and tensors belong to the model from now on.
    """
    head, splats = settled.field
    model.head = head.train(model.training)
    for name in BASE:
        model.gauss_params[name].copy_(splats[name])
    latents = Parameter(splats["latents"].detach())
    model.gauss_params["latents"] = latents
    taught = settled.moments["latents"].get(splats["latents"])
    optimizers.hold("field", list(head.parameters()), settled.moments["field"])
    optimizers.hold("latents", [latents], {} if taught is None else {latents: taught})
    for parameter in (*head.parameters(), latents):
        parameter.grad = None
    model.forget_fit()
    model.viewer_panel.offer_modes()


def shape_head(model, state: Mapping[str, Any]) -> None:
    """Give a model the head that a checkpoint's has, the whole one or what was left of it; its weights come later.

    Args:
        model: an NrfgsModel, whose configuration has the whole head.
        state: the checkpoint's state of the model.
    """
    whole = model.config.appearance
    found = state.get("_extra_state", {}).get("capacity")
    known = found is not None and isinstance(whole, NrfConfig)
    config = replace(whole, **found["head"]) if known else whole
    if config == model.head.config:
        return
    head = config.setup()
    head.scene_unit = model.scene_unit
    model.head = head.to(model.device).train(model.training)
    # In place: the optimiser of the latents was built on this very parameter.
    latents = model.gauss_params["latents"]
    latents.data = latents.data.new_zeros(len(latents), config.latent_dim)
