# SPDX-License-Identifier: Apache-2.0
"""Statistics of splats between two refinements: their screen-space gradients and radii. Growth by gradients sums norms
up and counts steps; growth by error keeps the largest norms.

On CUDA a Triton kernel updates them (`statistics_triton.py`); elsewhere, and for several cameras, PyTorch does.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.kernels.trial import tried_once


class Statistics(NamedTuple):
    """Tables of N splats, [N] each; None: not wanted."""

    widths: Tensor | None
    """largest radii, in shares of the image's longer side"""
    norms: Tensor | None
    """norms of screen-space gradients: their sum where steps are counted, otherwise the largest"""
    counts: Tensor | None = None
    """number of steps that have shown the splat"""


def accumulate(tables: Statistics, info: Mapping[str, Any], extent: float, gradients: Tensor | None) -> None:
    """Update the tables, in place, by a step. Norms that are not finite count as 0.

    Args:
        tables: tables of N splats, dense and float32 on CUDA.
        info: the rasterizer's, of M rows; those of radius 0 belong to invisible splats.
        extent: width and height of the image in the units by which gradients are to be taken.
        gradients: the loss's gradients by the rows' centres in pixels, [M, 2].
    """
    cameras = info["n_cameras"]
    scales = info["width"] / extent * cameras, info["height"] / extent * cameras
    device = info["radii"].device
    update = in_torch
    if device.type == "cuda" and cameras == 1 and try_kernel(device):  # of one camera no row occurs twice
        from nrfgs_ns.densification.statistics_triton import in_triton as update
    update(tables, info, scales, gradients)


def in_torch(
    tables: Statistics, info: Mapping[str, Any], scales: tuple[float, float], gradients: Tensor | None
) -> None:
    """`accumulate` in PyTorch, the kernel's twin; `scales` are factors in x and y of the gradients."""
    (widths, norms, counts), rows, radii = tables, info["gaussian_ids"], info["radii"]
    seen = radii > 0
    if widths is not None:
        widths.scatter_reduce_(0, rows, radii / float(max(info["width"], info["height"])), "amax")
    if norms is not None:
        x, y = gradients.unbind(dim=-1)
        norm = torch.hypot(x * scales[0], y * scales[1]).nan_to_num(0.0, 0.0) * seen
        norms.scatter_reduce_(0, rows, norm, "amax" if counts is None else "sum")
    if counts is not None:
        counts.index_add_(0, rows, seen.to(counts.dtype))


@tried_once("What densification remembers")
def try_kernel(device: torch.device) -> bool:
    """Whether the kernel runs on a CUDA device; the first step would compile it."""
    from nrfgs_ns.densification.statistics_triton import in_triton

    one, gradient = torch.ones(1, device=device), torch.ones(1, 2, device=device)
    info = {"gaussian_ids": torch.zeros(1, dtype=torch.int64, device=device), "radii": one.int()}
    info |= {"width": 1, "height": 1}
    for norms, counts in ((one.clone(), one.clone()), (one.clone(), None), (None, None)):  # after growth no norms
        in_triton(Statistics(one, norms, counts), info, (1.0, 1.0), gradient)
    return True
