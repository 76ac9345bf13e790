# SPDX-License-Identifier: Apache-2.0
"""`statistics.py` in one Triton kernel."""

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


launch_add = Launcher(add_kernel)


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
