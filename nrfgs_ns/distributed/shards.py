# SPDX-License-Identifier: Apache-2.0
"""Shards of the table of splats: cutting it up, moving rows between devices, putting it together for a checkpoint.

What belongs to a splat moves with it: its row of each parameter, of Adam's two moments, and of densification's
statistics. What does not (Adam's step counters, the schedulers) is the same on all devices.
"""

from collections.abc import Callable, Mapping, MutableMapping
from typing import Any

import torch
from gsplat.strategy.ops import _update_param_with_optimizer
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

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


def transfers(counts: list[int]) -> list[list[int]]:
    """Rows that each device sends to each, [W][W], so that all end with the same number, or one more. Devices with too
    many send to those with too few, in the order of their numbers."""
    devices, total = len(counts), sum(counts)
    surplus = [count - goal for count, goal in zip(counts, shard_counts(total, devices), strict=True)]
    plan = [[0] * devices for _ in counts]
    for giver in range(devices):
        for taker in range(devices):
            moved = min(max(surplus[giver], 0), max(-surplus[taker], 0))
            plan[giver][taker] = moved
            surplus[giver] -= moved
            surplus[taker] += moved
    return plan


@torch.no_grad()
def rebalance(
    splats: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    state: MutableMapping[str, Any],
    counts: list[int],
) -> list[int]:
    """Move splats between devices until all have the same number; entries of `splats`, and densification's statistics
    in `state`, are replaced. Returns every device's splats now.

    The rows that leave are spread evenly over the shard: new splats, which come last, crowd where the scene grows.
    """
    rank = comm.rank()
    plan = transfers(counts)
    sent, received = plan[rank], [row[rank] for row in plan]
    count = counts[rank]
    leaving = sum(sent)
    device = splats["means"].device
    going = torch.arange(leaving, device=device) * count // max(leaving, 1)
    staying = torch.ones(count, dtype=torch.bool, device=device).index_fill(0, going, False).nonzero().squeeze(1)

    def moved(rows: Tensor) -> Tensor:
        return torch.cat([rows.index_select(0, staying), comm.swap(rows.index_select(0, going), sent, received)])

    statistics = {name: value for name, value in state.items() if isinstance(value, Tensor)}
    for name in sorted(splats):  # in the same order on all devices
        _update_param_with_optimizer(
            lambda _, old: Parameter(moved(old.detach())), lambda _, old: moved(old), splats, optimizers, names=[name]
        )
    for name in sorted(statistics):
        state[name] = moved(statistics[name])
    return shard_counts(sum(counts), len(counts))
