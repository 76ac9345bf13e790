# SPDX-License-Identifier: Apache-2.0
"""Messages between devices. Every function here must be called on all of them, in the same order.

gsplat has such functions too (`gsplat.distributed`), but for NCCL alone; they also divide by the number of rows, which
is zero where a camera sees none of a device's splats, and their backward pass has no room for gsplat's `absgrad`.
"""

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

ROWS_AT_ONCE = 2**18
"""Rows of a device gathered at a time, which bounds what the main device needs beside its shard."""


rank = dist.get_rank
"""This device's number, from 0. Device 0 is the main one."""
world = dist.get_world_size
"""Number of devices W."""


def swap(rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
    """Send each device its part of the rows.

    Args:
        rows: [M, ...], those for device 0 first.
        sent, received: rows that go to, and come from, each device, [W].

    Returns:
        The rows that have arrived, those of device 0 first, [sum(received), ...].
    """
    arrived = rows.new_empty(sum(received), *rows.shape[1:])
    dist.all_to_all_single(arrived, rows.contiguous(), received, sent)
    return arrived


def swap_counts(counts: Tensor) -> tuple[list[int], list[int]]:
    """Tell each device how many rows it will get, given those for each, int64 [W]. Returns both; the host waits."""
    received = torch.empty_like(counts)
    dist.all_to_all_single(received, counts)
    return tuple(torch.stack([counts, received]).tolist())


def gather(value: Any) -> list[Any]:
    """Every device's value, [W]: plain numbers, strings, lists, dicts and CPU tensors."""
    values = [None] * world()
    dist.all_gather_object(values, value)
    return values


def gather_rows(rows: Tensor, counts: list[int]) -> Tensor | None:
    """A whole table on the main device's host, rows of device 0 first; None on the other devices.

    Args:
        rows: this device's part [N, ...].
        counts: every device's N.
    """
    main = rank() == 0
    parts: list[list[Tensor]] = [[] for _ in counts]
    for begin in range(0, max(*counts, 1), ROWS_AT_ONCE):
        block = rows[begin : begin + ROWS_AT_ONCE]
        received = [min(max(count - begin, 0), ROWS_AT_ONCE) if main else 0 for count in counts]
        arrived = swap(block, [len(block)] + [0] * (len(counts) - 1), received)
        if main:
            for part, piece in zip(parts, arrived.cpu().split(received), strict=True):
                part.append(piece)
    return torch.cat([piece for part in parts for piece in part]) if main else None


def sum_over_devices(tensors: list[Tensor]) -> None:
    """Replace each tensor by its sum over the devices, all in one message. Shapes are the same on all devices."""
    if not tensors:
        return
    flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
    dist.all_reduce(flat)
    for tensor, total in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(total.view_as(tensor))
