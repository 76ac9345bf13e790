# SPDX-License-Identifier: Apache-2.0
"""A checkpoint's head and photographs, and whether a model can load it."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.photograph import PhotographModel


def reduced_config(config: AppearanceHeadConfig, state: Mapping[str, Any]) -> AppearanceHeadConfig:
    """A head's configuration with the options that a checkpoint's head has set differently ("capacity")."""
    reduced = state.get("_extra_state", {}).get("capacity", {}).get("head", {})
    is_this_head = reduced.keys() <= {field.name for field in fields(config)}
    return replace(config, **reduced) if is_this_head else config


def differences(config: AppearanceHeadConfig, other: AppearanceHeadConfig) -> dict[str, Any]:
    """The options by which `other`, of the same head, differs from `config`, as `reduced_config` takes them."""
    return {name: value for name, value in vars(other).items() if value != getattr(config, name)}


def photographs_of(state: Mapping[str, Any]) -> PhotographModel | None:
    """The photographs' exposures in a checkpoint, if they were learnt."""
    prefix = "photograph."
    known = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    return PhotographModel.from_state(known) if known else None


def check_compatible(model: nn.Module, state: Mapping[str, Any]) -> None:
    """Refuse a checkpoint that this model cannot hold.

    Args:
        state: the checkpoint's state of the model. Tensors under "gauss_params." may have any number of rows.

    Raises:
        InputError: naming the first tensor that is missing, unknown, of another shape or not finite, and the fix.
    """
    written_by = state.get("_extra_state", {}).get("head", "another method")
    same = f"Both have the '{written_by}' head, but of another size or with other switches of the model."
    other = f"The checkpoint was written by the '{written_by}' head and this model has the '{model.head.name}' head."
    fix = (
        f"{same if written_by == model.head.name else other} Give the method and the --pipeline.model options of "
        "the checkpoint's training: see the config.yml beside it."
    )
    tensors = {name: value for name, value in state.items() if isinstance(value, Tensor)}
    given, expected = _shapes(tensors), _shapes(model.state_dict())
    for name in sorted(expected | given, key=lambda name: not name.startswith("gauss_params.")):
        if given.get(name) != expected.get(name):
            theirs, ours = given.get(name, "missing"), expected.get(name, "missing")
            raise InputError(f"'{name}' is {theirs} in the checkpoint and {ours} in this model. {fix}")
    for name, value in tensors.items():
        if value.numel() > 0 and not torch.isfinite(value).all():
            rows = (~torch.isfinite(value)).reshape(len(value), -1).any(dim=1).nonzero().flatten().tolist()
            raise InputError(
                f"The checkpoint's '{name}' is not finite in {len(rows)} of {len(value)} rows, first row {rows[0]}. "
                "Go on from an older one (ns-train --load-step); other commands take it where this one is removed."
            )


def _shapes(tensors: Mapping[str, Any]) -> dict[str, list[int]]:
    """Shapes by name, the splats' without their number."""
    shapes = {name: list(value.shape) for name, value in tensors.items() if isinstance(value, Tensor)}
    return {name: shape[1:] if name.startswith("gauss_params.") else shape for name, shape in shapes.items()}
