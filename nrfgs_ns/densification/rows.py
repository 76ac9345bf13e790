# SPDX-License-Identifier: Apache-2.0
"""Choosing and ordering the rows of a table of splats, with the optimisers' moments and what a strategy remembers."""

from collections.abc import Mapping
from typing import Any

import torch
from gsplat.strategy.ops import _update_param_with_optimizer
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer


def per_splat(state: Mapping[str, Any], count: int) -> dict[str, Tensor]:
    """The entries of a state that have a row for each of `count` splats."""
    return {
        name: value
        for name, value in state.items()
        if isinstance(value, Tensor) and value.dim() > 0 and len(value) == count
    }


@torch.no_grad()
def take_rows(model, optimizers: Mapping[str, Optimizer], rows: Tensor) -> None:
    """Let the given rows, in this order, be the splats: parameters, optimisers' moments, densification's statistics.

    Args:
        model: an NrfgsModel; entries of its `gauss_params` are replaced.
        optimizers: by group; those of `gauss_params` among them.
        rows: of the table, int64.
    """
    count, state = len(model.gauss_params["means"]), model.densification.state
    _update_param_with_optimizer(
        lambda _, old: Parameter(old.detach()[rows]), lambda _, old: old[rows], model.gauss_params, optimizers
    )
    state.update({name: value[rows] for name, value in per_splat(state, count).items()})
