# SPDX-License-Identifier: Apache-2.0
"""`statistics.py` in Triton: a kernel for sums and one for maxima."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from nrfgs_ns.kernels.launch import Launcher

BLOCK = 256
"""Rows that a program takes; a power of two."""


@triton.jit(do_not_specialize=["count"])
def add_kernel(
    sums, counts, largest, rows, gradients, radii, count, scale_x, scale_y, radius_scale,
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
    widths, errors, changes, rows, radii, gradients, change, count, radius_scale, scale_x, scale_y,
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


def add(
    sums: Tensor,
    counts: Tensor,
    largest: Tensor | None,
    rows: Tensor,
    gradients: Tensor,
    radii: Tensor,
    scales: tuple[float, float],
    radius_scale: float,
) -> None:
    """Add norms of gradients to `sums`, ones to `counts`, and let `largest` be at least the radii.

    Args:
        sums, counts, largest: [N], float32.
        rows: of these, all different, int64 [M].
        gradients: float32 [M, 2], dense.
        radii: int32 [M].
        scales, radius_scale: what gradients and radii are multiplied by.
    """
    count = len(rows)
    if count > 0:
        launch_add(
            (-(-count // BLOCK), 1, 1), sums, counts, sums if largest is None else largest, rows, gradients,
            radii.contiguous(), count, *scales, radius_scale,
            BLOCK=BLOCK, RADII=largest is not None, num_warps=4,
        )  # fmt: skip
        for written in (sums, counts, *(() if largest is None else (largest,))):
            torch.autograd.graph.increment_version(written)


def raise_maxima(
    widths: Tensor,
    errors: Tensor | None,
    changes: Tensor | None,
    rows: Tensor,
    radii: Tensor,
    gradients: Tensor | None,
    change: Tensor | None,
    radius_scale: float,
    scales: tuple[float, float],
) -> None:
    """Let the maxima be at least the radii, the norms of the gradients and the changes.

    Args:
        widths, errors, changes: [N], float32; None with what they are maxima of.
        rows: of these, all different, int64 [M].
        radii: int32 [M].
        gradients: float32 [M, 2], dense.
        change: float32 [M], dense.
        radius_scale, scales: factors of radii and gradients.
    """
    count = len(rows)
    if count > 0:
        none = widths  # stands for what the kernel does not touch
        launch_raise(
            (-(-count // BLOCK), 1, 1), widths,
            none if errors is None else errors, none if changes is None else changes, rows, radii.contiguous(),
            none if gradients is None else gradients, none if change is None else change,
            count, radius_scale, *scales,
            BLOCK=BLOCK, ERRORS=errors is not None, CHANGES=changes is not None, num_warps=4,
        )  # fmt: skip
        for written in (widths, errors, changes):
            if written is not None:
                torch.autograd.graph.increment_version(written)
