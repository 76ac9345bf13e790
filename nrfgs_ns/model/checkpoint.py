# SPDX-License-Identifier: Apache-2.0
"""What a checkpoint must satisfy before it is loaded."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.errors import InputError


def reduced_config(config: AppearanceHeadConfig, state: Mapping[str, Any]) -> AppearanceHeadConfig:
    """The configuration of the head that a checkpoint was written with.

    Args:
        config: the model's.
        state: the checkpoint's state of the model; its "capacity" says in which options its head differs, if it does.
    """
    found = state.get("_extra_state", {}).get("capacity", {}).get("head", {})
    is_this_head = found.keys() <= {one.name for one in fields(config)}
    return replace(config, **found) if is_this_head else config


def differences(config: AppearanceHeadConfig, other: AppearanceHeadConfig) -> dict[str, Any]:
    """The options in which another configuration of the same head differs from one, as `reduced_config` wants them."""
    names = [one.name for one in fields(config)]
    return {name: getattr(other, name) for name in names if getattr(other, name) != getattr(config, name)}


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
        f"{same if written_by == model.head.name else other} Use the config.yml that was saved beside the checkpoint "
        "(--load-config), or the same method and --pipeline.model options as in that training."
    )
    expected = {name: value for name, value in model.state_dict().items() if isinstance(value, Tensor)}
    given = {name: value for name, value in state.items() if isinstance(value, Tensor)}
    splats_first = sorted(expected, key=lambda name: not name.startswith("gauss_params."))
    for name in splats_first:
        if name not in given:
            raise InputError(f"The checkpoint has no '{name}'. {fix}")
        rows = 1 if name.startswith("gauss_params.") else 0
        if given[name].shape[rows:] != expected[name].shape[rows:]:
            raise InputError(
                f"The checkpoint's '{name}' is of shape {list(given[name].shape)}, this model's of shape "
                f"{list(expected[name].shape)}. {fix}"
            )
    for name in given:
        if name not in expected:
            raise InputError(f"The checkpoint has '{name}', which this model does not know. {fix}")
    for name, value in given.items():
        if value.numel() > 0 and not torch.isfinite(value).all():
            rows = (~torch.isfinite(value)).reshape(len(value), -1).any(dim=1).nonzero().flatten().tolist()
            raise InputError(
                f"The checkpoint's '{name}' is not finite in {len(rows)} of {len(value)} rows, first row {rows[0]}. "
                "Go on from an older one (ns-train --load-step); other commands take it where this one is removed."
            )
