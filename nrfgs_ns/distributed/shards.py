# SPDX-License-Identifier: Apache-2.0
"""Shards of the table of splats: cutting it up, and putting it together for a checkpoint.

What belongs to a splat goes with it: its row of each parameter, of Adam's two moments, and of densification's
statistics. What does not (Adam's step counters, the schedulers) is the same on all devices.
"""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from nrfgs_ns.distributed import comm


def shard_counts(total: int, devices: int) -> list[int]:
    """Rows of each device's shard, [W], when `total` rows are dealt out in turn."""
    return [len(range(rank, total, devices)) for rank in range(devices)]


def own_rows(table: Tensor) -> Tensor:
    """This device's rows of a whole table. They are dealt out in turn, because neighbours in a point cloud are
    neighbours in space, and each camera should see equally many splats of each device."""
    return table[comm.rank() :: comm.world()]


def map_model_rows(state: Mapping[str, Any], change: Callable[[Tensor], Any], prefix: str = "") -> dict[str, Any]:
    """A model's state, named after `prefix`, with each table of splats and of densification's statistics changed."""
    rows = f"{prefix}gauss_params."
    extra = state[f"{prefix}_extra_state"]
    strategy = {name: change(v) if isinstance(v, Tensor) else v for name, v in extra["strategy"].items()}
    changed = {name: change(value) if name.startswith(rows) else value for name, value in state.items()}
    return {**changed, f"{prefix}_extra_state": {**extra, "strategy": strategy}}


def map_moments(state: Mapping[str, Any], change: Callable[[Tensor], Any]) -> dict[str, Any]:
    """The state of one of the splats' optimisers with its moments changed; Adam's step counter, a scalar, stays."""
    moments = {
        index: {key: change(v) if isinstance(v, Tensor) and v.dim() > 0 else v for key, v in entry.items()}
        for index, entry in state["state"].items()
    }
    return {**state, "state": moments}
