# SPDX-License-Identifier: Apache-2.0
"""Shards of the table of splats: cutting it up, moving rows between devices, putting it together for a checkpoint.

What belongs to a splat moves with it: its row of each parameter, of Adam's two moments, and of densification's
statistics. What does not (Adam's step counters, the schedulers) is the same on all devices.
"""

from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from gsplat.strategy.ops import _update_param_with_optimizer
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from nrfgs_ns.densification.rows import per_splat
from nrfgs_ns.distributed import comm

PREFIX = "gauss_params."
"""Of the splats' tensors in a model's state."""


def shard_counts(total: int, devices: int) -> list[int]:
    """Rows of each device's shard, [W], when `total` rows are dealt out in turn."""
    return [len(range(rank, total, devices)) for rank in range(devices)]


def rows_of(rank: int, total: int, devices: int, written: list[int] | None = None) -> slice:
    """Which rows of a whole table are a device's.

    They are dealt out in turn, as neighbours in a point cloud are neighbours in space, and each camera should see as
    many splats of each device. A checkpoint that as many devices wrote is cut where it was put together, so that the
    training goes on as if it had not been interrupted.

    Args:
        total: rows N of the table.
        written: rows of each device that wrote the table, if it is known.
    """
    if written is not None and len(written) == devices and sum(written) == total:
        return slice(sum(written[:rank]), sum(written[: rank + 1]))
    return slice(rank, total, devices)


def cut_model_state(state: Mapping[str, Any], rows: slice) -> dict[str, Any]:
    """A whole model's state with the rows of one device."""
    total = len(state[f"{PREFIX}means"])
    cut = {name: value[rows] if name.startswith(PREFIX) else value for name, value in state.items()}
    extra = dict(cut["_extra_state"])
    statistics = {name: value[rows] for name, value in per_splat(extra["strategy"], total).items()}
    extra["strategy"] = {**extra["strategy"], **statistics}
    return {**cut, "_extra_state": extra}


def cut_optimizer_state(state: Mapping[str, Any], rows: slice) -> dict[str, Any]:
    """The state of the optimiser of one tensor of the splats, with the rows of one device."""
    moments = {
        index: {name: value[rows] if _is_moment(value) else value for name, value in of_one.items()}
        for index, of_one in state["state"].items()
    }
    return {**state, "state": moments}


def gather_model_state(state: MutableMapping[str, Any], counts: list[int], prefix: str) -> None:
    """Replace each device's rows in a pipeline's state, where the model's entries begin with `prefix`, by those of all
    devices, on the main one; None elsewhere.
    """
    for name in [name for name in state if name.startswith(prefix + PREFIX)]:
        state[name] = comm.gather_rows(state[name], counts)
    extra = dict(state[f"{prefix}_extra_state"])
    own = counts[comm.rank()]
    gathered = {name: comm.gather_rows(value, counts) for name, value in per_splat(extra["strategy"], own).items()}
    extra["strategy"] = {**extra["strategy"], **gathered}
    state[f"{prefix}_extra_state"] = {**extra, "shards": counts}


def gather_optimizer_state(state: Mapping[str, Any], counts: list[int]) -> dict[str, Any]:
    """`state_dict` of the optimiser of one tensor of the splats, with the rows of all devices; None for the rows
    elsewhere than on the main one."""
    moments = {
        index: {name: comm.gather_rows(value, counts) if _is_moment(value) else value for name, value in entry.items()}
        for index, entry in state["state"].items()
    }
    return {**state, "state": moments}


def transfers(counts: list[int]) -> list[list[int]]:
    """How many rows each device sends to each, [W][W], for all to end with the same number, or one more.

    Those with too many send to those with too few, in the order of their numbers; nobody does both.
    """
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
    """Move splats between devices until all have the same number.

    The rows that leave are spread evenly over the shard: new splats, which come last, crowd where the scene grows.

    Args:
        splats: this device's table; entries are replaced.
        state: densification's; entries with a row per splat are replaced.

    Returns:
        Every device's splats now.
    """
    plan, rank = transfers(counts), comm.rank()
    sent, received = plan[rank], [row[rank] for row in plan]
    count, leaving = counts[rank], sum(sent)
    device = splats["means"].device
    going = torch.arange(leaving, device=device) * count // max(leaving, 1)
    staying = torch.ones(count, dtype=torch.bool, device=device)
    staying[going] = False
    staying = staying.nonzero().squeeze(1)

    def moved(rows: Tensor) -> Tensor:
        arrived = comm.swap(rows.index_select(0, going), sent, received)
        return torch.cat([rows.index_select(0, staying), arrived])

    statistics = per_splat(state, count)
    for name in sorted(splats):
        _update_param_with_optimizer(
            lambda _, old: Parameter(moved(old.detach())),
            lambda _, old: moved(old),
            splats,
            optimizers,
            names=[name],
        )
    for name in sorted(statistics):
        state[name] = moved(statistics[name])
    return shard_counts(sum(counts), len(counts))


def _is_moment(value: Any) -> bool:
    """Whether an entry of Adam's state has a row for each splat; its step counter has none."""
    return isinstance(value, Tensor) and value.dim() > 0
