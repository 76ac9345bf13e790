# SPDX-License-Identifier: Apache-2.0
"""`statistics.py` in Triton: a kernel for sums and one for maxima."""

from collections.abc import Mapping, Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from nrfgs_ns.densification.statistics import Maxima, Step
from nrfgs_ns.kernels.launch import Launcher

BLOCK = 256
"""Rows that a program takes; a power of two."""


@triton.jit(do_not_specialize=["count"])
def add_kernel(
    sums, counts, largest, rows, radii, gradients, count, scale_x, scale_y, radius_scale,
    BLOCK: tl.constexpr, RADII: tl.constexpr,
):  # fmt: skip
    """Add rows that are all different, but those of radius 0. Without RADII, `largest` is not touched."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    radius = tl.load(radii + at, mask=at < count, other=0).to(tl.float32)
    valid = radius > 0.0
    row = tl.load(rows + at, mask=valid, other=0)
    x = tl.load(gradients + 2 * at, mask=valid, other=0.0) * scale_x
    y = tl.load(gradients + 2 * at + 1, mask=valid, other=0.0) * scale_y
    sum = tl.load(sums + row, mask=valid, other=0.0) + tl.sqrt(x * x + y * y)
    seen = tl.load(counts + row, mask=valid, other=0.0) + 1.0
    tl.store(sums + row, sum, mask=valid)
    tl.store(counts + row, seen, mask=valid)
    if RADII:
        share = radius * radius_scale
        tl.store(largest + row, tl.maximum(tl.load(largest + row, mask=valid, other=0.0), share), mask=valid)


@triton.jit(do_not_specialize=["count"])
def raise_kernel(
    widths, errors, changes, rows, radii, gradients, change, count, scale_x, scale_y, radius_scale,
    BLOCK: tl.constexpr, ERRORS: tl.constexpr, CHANGES: tl.constexpr,
):  # fmt: skip
    """Raise maxima to rows that are all different, except those of radius 0."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    radius = tl.load(radii + at, mask=at < count, other=0).to(tl.float32)
    valid = radius > 0.0
    row = tl.load(rows + at, mask=valid, other=0)
    largest = tl.load(widths + row, mask=valid, other=0.0)
    tl.store(widths + row, tl.maximum(largest, radius * radius_scale), mask=valid)
    if ERRORS:
        x = tl.load(gradients + 2 * at, mask=valid, other=0.0) * scale_x
        y = tl.load(gradients + 2 * at + 1, mask=valid, other=0.0) * scale_y
        largest = tl.load(errors + row, mask=valid, other=0.0)
        tl.store(errors + row, tl.maximum(largest, tl.sqrt(x * x + y * y)), mask=valid)
    if CHANGES:
        largest = tl.load(changes + row, mask=valid, other=0.0)
        tl.store(changes + row, tl.maximum(largest, tl.load(change + at, mask=valid, other=0.0)), mask=valid)


launch_add = Launcher(add_kernel)
launch_raise = Launcher(raise_kernel)


def add(state: Mapping[str, Tensor], step: Step, gradients: Tensor) -> None:
    """`add_in_torch` of float32 tensors, dense, and rows that are all different."""
    sums, counts, largest = state["grad2d"], state["count"], state.get("radii")
    _launch(launch_add, (sums, counts, largest), step, (gradients,), RADII=largest is not None)


def raise_maxima(maxima: Maxima, step: Step, gradients: Tensor | None, change: Tensor | None) -> None:
    """`raise_in_torch` of float32 tensors, dense, and rows that are all different."""
    wanted = {"ERRORS": maxima.errors is not None, "CHANGES": maxima.changes is not None}
    _launch(launch_raise, maxima, step, (gradients, change), **wanted)


def _launch(
    launch: Launcher, written: Sequence[Tensor | None], step: Step, read: Sequence[Tensor | None], **wanted: bool
) -> None:
    """Launch a kernel with the tensors that it writes and reads; the first stands for those that it does not touch."""
    count = len(step.rows)
    if count > 0:
        tensors = *written, step.rows, step.radii.contiguous(), *read
        tensors = (written[0] if value is None else value for value in tensors)
        grid, constants = (-(-count // BLOCK), 1, 1), {"BLOCK": BLOCK, **wanted, "num_warps": 4}
        launch(grid, *tensors, count, *step.scales, 1.0 / step.side, **constants)
        for value in written:
            if value is not None:
                torch.autograd.graph.increment_version(value)
