# SPDX-License-Identifier: Apache-2.0
"""`statistics.in_torch` as a Triton kernel."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from nrfgs_ns.densification.statistics import Statistics, Step

BLOCK = 256
"""Rows that a program takes; a power of two."""


@triton.jit(do_not_specialize=["count"])
def statistics_kernel(
    widths, norms, counts, changes, rows, radii, gradients, change, count, scale_x, scale_y, radius_scale,
    BLOCK: tl.constexpr, WIDTHS: tl.constexpr, NORMS: tl.constexpr, COUNTS: tl.constexpr, CHANGES: tl.constexpr,
):  # fmt: skip
    """Take the rows of positive radius, which must be all different, into the tables; those that are not wanted
    (WIDTHS, NORMS, COUNTS, CHANGES) are not touched."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    radius = tl.load(radii + at, mask=at < count, other=0).to(tl.float32)
    valid = radius > 0.0
    row = tl.load(rows + at, mask=valid, other=0)
    if WIDTHS:
        old = tl.load(widths + row, mask=valid, other=0.0)
        tl.store(widths + row, tl.maximum(old, radius * radius_scale), mask=valid)
    if NORMS:
        x = tl.load(gradients + 2 * at, mask=valid, other=0.0) * scale_x
        y = tl.load(gradients + 2 * at + 1, mask=valid, other=0.0) * scale_y
        norm = tl.sqrt(x * x + y * y)
        norm = tl.where(norm < float("inf"), norm, 0.0)
        old = tl.load(norms + row, mask=valid, other=0.0)
        if COUNTS:
            norm += old
        tl.store(norms + row, tl.maximum(old, norm), mask=valid)
    if COUNTS:
        tl.store(counts + row, tl.load(counts + row, mask=valid, other=0.0) + 1.0, mask=valid)
    if CHANGES:
        old = tl.load(changes + row, mask=valid, other=0.0)
        new = tl.load(change + at, mask=valid, other=0.0)
        tl.store(changes + row, tl.where(new > old, new, old), mask=valid)  # NaN is not greater


def in_triton(tables: Statistics, step: Step, gradients: Tensor | None, change: Tensor | None) -> None:
    """`statistics.in_torch` for dense float32 tensors and rows that are all different."""
    count = len(step.rows)
    written = [table for table in tables if table is not None]
    if count > 0:
        arguments = *tables, step.rows, step.radii.contiguous(), gradients, change
        arguments = (written[0] if value is None else value for value in arguments)  # a pointer that is not used
        wanted = {name.upper(): table is not None for name, table in tables._asdict().items()}
        grid = (-(-count // BLOCK),)
        statistics_kernel[grid](*arguments, count, *step.scales, 1 / step.side, BLOCK=BLOCK, **wanted, num_warps=4)
        for table in written:
            torch.autograd.graph.increment_version(table)
