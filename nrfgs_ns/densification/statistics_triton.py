# SPDX-License-Identifier: Apache-2.0
"""`statistics.in_torch` as a Triton kernel."""

from collections.abc import Mapping
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nrfgs_ns.densification.statistics import Statistics

BLOCK = 256
"""Rows that a program takes; a power of two."""


@triton.jit(do_not_specialize=["count"])
def statistics_kernel(
    widths, norms, counts, rows, radii, gradients, count, scale_x, scale_y, radius_scale,
    BLOCK: tl.constexpr, WIDTHS: tl.constexpr, NORMS: tl.constexpr, COUNTS: tl.constexpr,
):  # fmt: skip
    """Take the rows of positive radius, which must be all different, into the tables; those that are not wanted
    (WIDTHS, NORMS, COUNTS) are not touched."""
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


def in_triton(
    tables: Statistics, info: Mapping[str, Any], scales: tuple[float, float], gradients: Tensor | None
) -> None:
    """`statistics.in_torch` for dense float32 tensors and rows that are all different."""
    count = len(info["gaussian_ids"])
    written = [table for table in tables if table is not None]
    if count > 0:
        dense = (value if value is None else value.contiguous() for value in (info["radii"], gradients))
        arguments = *tables, info["gaussian_ids"], *dense
        arguments = (written[0] if value is None else value for value in arguments)  # a pointer that is not used
        wanted = {name.upper(): table is not None for name, table in tables._asdict().items()}
        grid = (-(-count // BLOCK),)
        radius_scale = 1 / float(max(info["width"], info["height"]))
        statistics_kernel[grid](*arguments, count, *scales, radius_scale, BLOCK=BLOCK, **wanted, num_warps=4)
        for table in written:
            torch.autograd.graph.increment_version(table)
