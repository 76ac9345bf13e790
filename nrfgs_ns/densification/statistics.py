# SPDX-License-Identifier: Apache-2.0
"""What growth remembers of each step: how much splats wanted to move on the screen, how large they were, and how much
the view changed their opacity. Growth by gradients adds it up, growth by error keeps the largest.

On CUDA a Triton kernel does it (`statistics_triton.py`), elsewhere and for several cameras PyTorch does.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.kernels.trial import tried_once


class Tables(NamedTuple):
    """What is remembered of each of N splats, [N] each; None: not wanted."""

    widths: Tensor | None
    """largest radii, in shares of the image's longer side"""
    norms: Tensor | None
    """norms of screen-space gradients, their sum or the largest"""
    others: Tensor | None
    """number of steps, or the largest change of opacity"""


class Step(NamedTuple):
    """What a step shows of M splats."""

    rows: Tensor
    """of the tables, int64 [M]"""
    radii: Tensor
    """pixels, [M]; 0 where a row is not to count"""
    side: float
    """the image's longer one, which radii are divided by"""
    scales: tuple[float, float]
    """what gradients by the rows' centres, in pixels, are multiplied by"""


def remember(
    tables: Tables,
    info: Mapping[str, Any],
    extent: float,
    gradients: Tensor | None,
    change: Tensor | None = None,
    sums: bool = False,
) -> None:
    """Take a step into the tables, which are written to. Norms that are not finite count as 0, changes that are NaN not
    at all.

    Args:
        info: the rasterizer's; M rows, those of radius 0 of splats that are not visible.
        extent: width and height of the image in which gradients are measured.
        gradients: of the loss by the rows' centres, in pixels, [M, 2].
        change: of the rows' opacities, [M].
        sums: add up norms and steps, instead of keeping the largest norms and changes.
    """
    width, height, cameras = info["width"], info["height"], info["n_cameras"]
    scales = width / extent * cameras, height / extent * cameras
    step = Step(info["gaussian_ids"], info["radii"], float(max(width, height)), scales)
    tensors = [value for value in (*tables, gradients, change) if value is not None]
    take = in_torch
    if (
        tensors[0].is_cuda
        and cameras == 1  # no row occurs twice
        and all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in tensors)
        and try_kernel(tensors[0].device)
    ):
        from nrfgs_ns.densification.statistics_triton import take
    take(tables, step, gradients, change, sums)


def in_torch(tables: Tables, step: Step, gradients: Tensor | None, change: Tensor | None, sums: bool) -> None:
    """The kernel's twin: the same in PyTorch."""
    (widths, norms, others), (rows, radii, side, scales) = tables, step
    seen = radii > 0
    if widths is not None:
        widths.scatter_reduce_(0, rows, radii / side, "amax")
    if norms is not None:
        x, y = gradients.unbind(dim=-1)
        norm = torch.hypot(x * scales[0], y * scales[1]).nan_to_num(0.0, 0.0) * seen
        norms.scatter_reduce_(0, rows, norm, "sum" if sums else "amax")
    if others is not None and sums:
        others.index_add_(0, rows, seen.to(others.dtype))
    elif others is not None:
        others.scatter_reduce_(0, rows, change.where(seen & ~change.isnan(), -math.inf), "amax")


@tried_once("What densification remembers")
def try_kernel(device: torch.device) -> None:
    """Whether the kernel runs on a CUDA device; the first step would compile it."""
    from nrfgs_ns.densification.statistics_triton import take

    one, two = torch.ones(1, device=device), torch.ones(1, 2, device=device)
    step = Step(torch.zeros(1, dtype=torch.int64, device=device), one.int(), 1.0, (1.0, 1.0))
    take(Tables(one, one.clone(), one.clone()), step, two, None, True)
    for norms in (one.clone(), None):  # while splats grow, and after it
        take(Tables(one, norms, one.clone()), step, two, one, False)
