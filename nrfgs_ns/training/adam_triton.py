# SPDX-License-Identifier: Apache-2.0
"""Adam of many tensors in one Triton launch, whatever their learning rates; torch's fused Adam is its twin.

PyTorch launches once for each learning rate, and gives 65,536 numbers to each block of threads: a table of a hundred
thousand splats keeps a dozen of a card's hundred multiprocessors busy, and small tables take as long as large ones.
Here a program takes `BLOCK` numbers of any tensor. What the kernel must know of each tensor is a column of one table,
copied to the device in each step, because gradients lie elsewhere in each.

The equations are torch's (Kingma and Ba 2015, with bias correction), in float32; the corrections, which begin at
1 - beta2, in float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from nrfgs_ns.kernels.launch import Launcher

BLOCK = 2048
"""Numbers that a program takes; a power of two."""
WARPS = 4
"""Warps of a program."""
COLUMNS = 32
"""Most tensors of a launch; a power of two."""
END, SIZE, PARAMETER, GRADIENT, MEAN, SQUARE, STEP, RATE, BETA1, BETA2, EPSILON, DECAY = map(tl.constexpr, range(12))
"""Rows of the table: the last program's number + 1, how many numbers there are, where they lie, and the constants."""
ROWS = 12
ADDRESSES = slice(PARAMETER.value, STEP.value + 1)
NUMBERS = slice(RATE.value, DECAY.value + 1)


@dataclass
class AdamTensor:
    """One tensor of a step. All of its tensors are float32, dense and on one device; `step` has one number."""

    parameter: Tensor
    gradient: Tensor
    mean: Tensor
    """exp_avg"""
    square: Tensor
    """exp_avg_sq"""
    step: Tensor
    """of this step, from 1"""
    group: dict[str, Any]
    """torch's options: lr, betas, eps, weight_decay"""


@triton.jit
def _entry(table, row, column, COLUMNS: tl.constexpr):
    """An integer of the table."""
    return tl.load(table + row * COLUMNS + column)


@triton.jit
def _number(table, row, column, COLUMNS: tl.constexpr):
    """A number of the table, float64."""
    return _entry(table, row, column, COLUMNS).to(tl.float64, bitcast=True)


@triton.jit
def _place(base, table, row, column, COLUMNS: tl.constexpr):
    """Where a tensor begins. Its distance from `base` is whole fours of numbers, so that four are read at once."""
    return base + tl.multiple_of(_entry(table, row, column, COLUMNS), 4)


@triton.jit
def adam_kernel(base, table, skip, BLOCK: tl.constexpr, COLUMNS: tl.constexpr):
    """One step of all tensors of `table`, unless `skip` is not 0."""
    if tl.load(skip) == 0.0:
        program = tl.program_id(0)
        ends = tl.load(table + END * COLUMNS + tl.arange(0, COLUMNS))
        column = tl.sum((ends <= program).to(tl.int32), axis=0)
        first = tl.max(tl.where(ends <= program, ends, 0), axis=0)

        steps = tl.load(base + _entry(table, STEP, column, COLUMNS)).to(tl.float64)
        beta1 = _number(table, BETA1, column, COLUMNS)
        beta2 = _number(table, BETA2, column, COLUMNS)
        correction1 = 1.0 - tl.exp(steps * tl.log(beta1))
        correction2 = 1.0 - tl.exp(steps * tl.log(beta2))
        rate = (_number(table, RATE, column, COLUMNS) / correction1).to(tl.float32)
        root = tl.sqrt(correction2).to(tl.float32)
        epsilon = _number(table, EPSILON, column, COLUMNS).to(tl.float32)
        decay = _number(table, DECAY, column, COLUMNS).to(tl.float32)
        new1 = (1.0 - beta1).to(tl.float32)
        new2 = (1.0 - beta2).to(tl.float32)
        old1 = beta1.to(tl.float32)
        old2 = beta2.to(tl.float32)

        at = (program - first) * BLOCK + tl.arange(0, BLOCK)
        inside = at < _entry(table, SIZE, column, COLUMNS)
        parameters = _place(base, table, PARAMETER, column, COLUMNS) + at
        means = _place(base, table, MEAN, column, COLUMNS) + at
        squares = _place(base, table, SQUARE, column, COLUMNS) + at
        parameter = tl.load(parameters, mask=inside)
        gradient = tl.load(_place(base, table, GRADIENT, column, COLUMNS) + at, mask=inside)
        mean = tl.load(means, mask=inside)
        square = tl.load(squares, mask=inside)
        gradient += decay * parameter
        mean = old1 * mean + new1 * gradient
        square = old2 * square + new2 * gradient * gradient
        parameter -= rate * mean / (tl.sqrt(square) / root + epsilon)
        tl.store(parameters, parameter, mask=inside)
        tl.store(means, mean, mask=inside)
        tl.store(squares, square, mask=inside)


launch = Launcher(adam_kernel)


def is_taken(tensor: AdamTensor, device: torch.device) -> bool:
    """Whether the kernel can step it: float32, dense, on a device, and aligned, for four numbers are read at once."""
    parts = tensor.parameter, tensor.gradient, tensor.mean, tensor.square
    return all(
        part.dtype == torch.float32 and part.device == device and part.is_contiguous() and part.data_ptr() % 16 == 0
        for part in parts
    )


class AdamTable:
    """The table on one device, and its copy in host memory."""

    def __init__(self, device: torch.device):
        on_cuda = device.type == "cuda"
        self.device = torch.zeros(ROWS, COLUMNS, dtype=torch.int64, device=device)
        self.host = torch.zeros(ROWS, COLUMNS, dtype=torch.int64, pin_memory=on_cuda)
        self.rows = self.host.numpy()
        self.numbers = self.rows.view(np.float64)
        self.copied = torch.cuda.Event() if on_cuda else None
        self.never = torch.zeros((), device=device)

    def step(self, tensors: Sequence[AdamTensor], skip: Tensor | None) -> None:
        """One step of at most `COLUMNS` tensors, in place.

        Args:
            tensors: none of them empty.
            skip: a number on the device, not 0 to leave everything as it is.
        """
        if self.copied is not None:
            self.copied.synchronize()  # the copy of the step before, which has long been made
        base, count = tensors[0].parameter, len(tensors)
        origin = base.data_ptr()
        sizes = [tensor.parameter.numel() for tensor in tensors]
        addresses = [
            [getattr(tensor, name).data_ptr() - origin for tensor in tensors]
            for name in ("parameter", "gradient", "mean", "square", "step")
        ]
        groups = [tensor.group for tensor in tensors]
        programs = -(-np.array(sizes) // BLOCK)
        rows = self.rows
        rows[END, :count] = np.cumsum(programs)
        rows[END, count:] = np.iinfo(np.int64).max
        rows[SIZE, :count] = sizes
        rows[ADDRESSES, :count] = np.array(addresses) >> 2
        self.numbers[NUMBERS, :count] = [
            [group["lr"] for group in groups],
            [group["betas"][0] for group in groups],
            [group["betas"][1] for group in groups],
            [group["eps"] for group in groups],
            [group["weight_decay"] for group in groups],
        ]
        self.device.copy_(self.host, non_blocking=True)
        if self.copied is not None:
            self.copied.record()
        skip = self.never if skip is None else skip
        launch((int(programs.sum()), 1, 1), base, self.device, skip, BLOCK=BLOCK, COLUMNS=COLUMNS, num_warps=WARPS)
        for tensor in tensors:  # which PyTorch cannot know
            for written in (tensor.parameter, tensor.mean, tensor.square):
                torch.autograd.graph.increment_version(written)
