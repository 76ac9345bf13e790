# SPDX-License-Identifier: Apache-2.0
"""Adam of many tensors in one Triton launch, whatever their learning rates; torch's fused Adam is its twin.

PyTorch launches once for each learning rate, with 65,536 numbers to each block of threads: small tables take as long as
large ones. Here a program takes `BLOCK` numbers of any tensor. Each tensor has a column in a table, which is copied to
the device in each step, because the gradients' addresses change.

The equations are torch's (Kingma and Ba 2015), in float32; the bias corrections in float64.
"""

from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

ALIGNMENT = 16
"""Bytes of four numbers; parts of PyTorch's allocations may be unaligned."""
BLOCK = 512
"""Numbers per program; a power of two."""
WARPS = 4
"""Warps per program."""
COLUMNS = 64
"""Most tensors in a step; a power of two."""
END, SIZE, PARAMETER, MEAN, SQUARE, STEP, GRADIENT, RATE, BETA1, BETA2, EPSILON, DECAY = map(tl.constexpr, range(12))
"""Rows of the table: the last program's number + 1, the tensor's size, addresses, and constants."""
ROWS = 12
FIXED = slice(PARAMETER.value, STEP.value + 1)
CONSTANTS = slice(RATE.value, DECAY.value + 1)

Part = tuple[dict[str, Any], Tensor, dict[str, Tensor]]
"""torch's options of a parameter (lr, betas, eps, weight_decay), the parameter, and its state."""


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
    """Where a tensor begins. Its distance from `base` is a multiple of four numbers, so that four are read at once."""
    return base + tl.multiple_of(_entry(table, row, column, COLUMNS), 4)


@triton.jit
def adam_kernel(base, table, skip, BLOCK: tl.constexpr, COLUMNS: tl.constexpr):
    """One step of all tensors of `table`, which their counters have counted; if `skip` is not 0, only uncount it."""
    program = tl.program_id(0)
    ends = tl.load(table + END * COLUMNS + tl.arange(0, COLUMNS))
    column = tl.sum((ends <= program).to(tl.int32), axis=0)
    first = tl.max(tl.where(ends <= program, ends, 0), axis=0)
    counter = base + _entry(table, STEP, column, COLUMNS)
    counted = tl.load(counter)
    if tl.load(skip) != 0.0:
        if program == first:
            tl.store(counter, counted - 1.0)
    else:
        steps = counted.to(tl.float64)
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


class AdamTable:
    """The table on one device, and its copy in host memory, where addresses and sizes are written if they change."""

    def __init__(self, device: torch.device):
        on_cuda = device.type == "cuda"
        self.device = torch.zeros(ROWS, COLUMNS, dtype=torch.int64, device=device)
        self.host = torch.zeros(ROWS, COLUMNS, dtype=torch.int64, pin_memory=on_cuda)
        self.rows = self.host.numpy()
        self.numbers = self.rows.view(np.float64)
        self.copied = torch.cuda.Event() if on_cuda else None
        self.never = torch.zeros((), device=device)
        self.fixed: list[int] = []
        self.programs = 0

    def step(self, work: list[Part], skip: Tensor | None) -> bool:
        """One step, in place, of parameters with gradients whose counters have counted it.

        Args:
            skip: a number on the device, not 0 to skip the step and uncount it; None: do not skip.

        Returns:
            Whether the kernel made the step: it takes at most `COLUMNS` tensors, all float32, dense, aligned and on the
            table's device. If not, nothing has changed.
        """
        fixed: list[int] = []
        gradients: list[int] = []
        constants: list[tuple] = []
        aligned = True
        for group, parameter, state in work:
            mean, square, gradient = state["exp_avg"], state["exp_avg_sq"], parameter.grad
            fixed += (parameter.data_ptr(), mean.data_ptr(), square.data_ptr(), state["step"].data_ptr())
            fixed.append(parameter.numel())
            gradients.append(gradient.data_ptr())
            aligned = aligned and gradient.is_contiguous() and gradients[-1] % ALIGNMENT == 0
            constants.append((group["lr"], *group["betas"], group["eps"], group["weight_decay"]))
        if self.copied is not None:
            self.copied.synchronize()  # the copy of the step before, which has long been made
        if not aligned or (fixed != self.fixed and not self._write_fixed(work, fixed)):
            return False
        base = work[0][1]
        count = len(gradients)
        self.numbers[CONSTANTS, :count] = np.array(constants).T
        self.rows[GRADIENT, :count] = (np.array(gradients) - base.data_ptr()) >> 2
        self.device.copy_(self.host, non_blocking=True)
        if self.copied is not None:
            self.copied.record()
        skip = self.never if skip is None else skip
        adam_kernel[(self.programs,)](base, self.device, skip, BLOCK=BLOCK, COLUMNS=COLUMNS, num_warps=WARPS)
        for _, parameter, _ in work:  # PyTorch cannot know that they have been written to
            torch.autograd.graph.increment_version(parameter)
        return True

    def _write_fixed(self, work: list[Part], fixed: list[int]) -> bool:
        """Write the addresses and sizes that stay from step to step; whether the kernel takes these tensors."""
        self.fixed = []
        if len(work) > COLUMNS or not all(
            tensor.dtype == torch.float32
            and tensor.device == self.device.device
            and tensor.is_contiguous()
            and tensor.data_ptr() % ALIGNMENT == 0
            for _, parameter, state in work
            for tensor in (parameter, state["exp_avg"], state["exp_avg_sq"])
        ):
            return False
        each = np.array(fixed).reshape(-1, 5).T
        count = each.shape[1]
        programs = -(-each[4] // BLOCK)
        self.rows[END, :count] = np.cumsum(programs)
        self.rows[END, count:] = np.iinfo(np.int64).max
        self.rows[SIZE, :count] = each[4]
        self.rows[FIXED, :count] = (each[:4] - each[0, 0]) >> 2
        self.fixed = fixed
        self.programs = int(programs.sum())
        return True
