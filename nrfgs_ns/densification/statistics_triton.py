# SPDX-License-Identifier: Apache-2.0
"""`statistics.py` in a Triton kernel, for sums and for maxima."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from nrfgs_ns.densification.statistics import Step, Tables
from nrfgs_ns.kernels.launch import Launcher

BLOCK = 256
"""Rows that a program takes; a power of two."""


@triton.jit(do_not_specialize=["count"])
def take_kernel(
    widths, norms, others, rows, radii, gradients, change, count, scale_x, scale_y, radius_scale,
    BLOCK: tl.constexpr, SUMS: tl.constexpr, WIDTHS: tl.constexpr, NORMS: tl.constexpr, OTHERS: tl.constexpr,
):  # fmt: skip
    """Take rows that are all different, except those of radius 0: SUMS of norms and of ones, or maxima of norms and of
    changes. Without WIDTHS, NORMS or OTHERS these tables are not touched."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    radius = tl.load(radii + at, mask=at < count, other=0).to(tl.float32)
    valid = radius > 0.0
    row = tl.load(rows + at, mask=valid, other=0)
    if WIDTHS:
        held = tl.load(widths + row, mask=valid, other=0.0)
        tl.store(widths + row, tl.maximum(held, radius * radius_scale), mask=valid)
    if NORMS:
        x = tl.load(gradients + 2 * at, mask=valid, other=0.0) * scale_x
        y = tl.load(gradients + 2 * at + 1, mask=valid, other=0.0) * scale_y
        norm = tl.sqrt(x * x + y * y)
        norm = tl.where(norm < float("inf"), norm, 0.0)
        held = tl.load(norms + row, mask=valid, other=0.0)
        if SUMS:
            norm += held
        tl.store(norms + row, tl.maximum(held, norm), mask=valid)
    if OTHERS:
        held = tl.load(others + row, mask=valid, other=0.0)
        other = held + 1.0
        if not SUMS:
            other = tl.load(change + at, mask=valid, other=0.0)
        tl.store(others + row, tl.where(other > held, other, held), mask=valid)  # NaN is no more than what is held


launch = Launcher(take_kernel)


def take(tables: Tables, step: Step, gradients: Tensor | None, change: Tensor | None, sums: bool) -> None:
    """`statistics.in_torch` of float32 tensors, dense, and rows that are all different."""
    count = len(step.rows)
    written = [table for table in tables if table is not None]
    if count > 0:
        arguments = *tables, step.rows, step.radii.contiguous(), gradients, change
        arguments = (written[0] if value is None else value for value in arguments)  # which is not touched
        wanted = dict(zip(("WIDTHS", "NORMS", "OTHERS"), (table is not None for table in tables), strict=True))
        grid = -(-count // BLOCK), 1, 1
        launch(grid, *arguments, count, *step.scales, 1 / step.side, BLOCK=BLOCK, SUMS=sums, **wanted, num_warps=4)
        for table in written:
            torch.autograd.graph.increment_version(table)
