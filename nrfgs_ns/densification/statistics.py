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


class Step(NamedTuple):
    """What a step shows of M splats."""

    rows: Tensor
    """of the statistics, int64 [M]"""
    radii: Tensor
    """pixels, [M]; 0 where a row is not to count"""
    side: float
    """the image's longer one, which radii are divided by"""
    scales: tuple[float, float]
    """what gradients by the rows' centres, in pixels, are multiplied by"""


def _step(info: Mapping[str, Any], extent: float) -> Step:
    """The rasterizer's `info` of a step, with gradients in an image as wide and high as `extent`."""
    width, height, cameras = info["width"], info["height"], info["n_cameras"]
    scales = width / extent * cameras, height / extent * cameras
    return Step(info["gaussian_ids"], info["radii"], float(max(width, height)), scales)


def take_statistics(state: Mapping[str, Tensor], info: Mapping[str, Any], gradients: Tensor) -> None:
    """Add a step's screen-space gradients, in an image of [-1, 1], and radii, in shares of the longer side.

    Args:
        state: "grad2d" and "count" [N], and "radii" [N] if they are wanted: written to.
        info: the rasterizer's; M rows, those of radius 0 of splats that are not visible.
        gradients: of the loss by the rows' centres, in pixels, [M, 2].
    """
    add = add_in_torch
    if _kernels_take(info, gradients, *(state[name] for name in ("grad2d", "count", "radii") if name in state)):
        from nrfgs_ns.densification.statistics_triton import add
    add(state, _step(info, 2.0), gradients)


def add_in_torch(state: Mapping[str, Tensor], step: Step, gradients: Tensor) -> None:
    """The kernel's twin: the same in PyTorch."""
    visible = step.radii > 0
    gradients = gradients.clone()
    gradients[:, 0] *= step.scales[0]
    gradients[:, 1] *= step.scales[1]
    norms = gradients.norm(dim=-1) * visible
    state["grad2d"].index_add_(0, step.rows, norms)
    state["count"].index_add_(0, step.rows, visible.to(norms.dtype))
    if "radii" in state:
        state["radii"][step.rows] = torch.maximum(state["radii"][step.rows], step.radii / step.side)


class Maxima(NamedTuple):
    """The largest of each of N splats; None: not wanted."""

    widths: Tensor
    """radii, in shares of the longer side"""
    errors: Tensor | None
    """norms of screen-space gradients, in an image of [0, 1]"""
    changes: Tensor | None
    """of opacity"""


def take_maxima(maxima: Maxima, info: Mapping[str, Any], gradients: Tensor | None, change: Tensor | None) -> None:
    """Let the maxima, which are written to, be at least a step's. Radii and norms are never below 0.

    Args:
        info: the rasterizer's, as in `take_statistics`.
        gradients: of the loss by the rows' centres, in pixels, [M, 2].
        change: of the rows' opacities, [M].
    """
    raise_maxima = raise_in_torch
    if _kernels_take(info, *(value for value in (*maxima, gradients, change) if value is not None)):
        from nrfgs_ns.densification.statistics_triton import raise_maxima
    raise_maxima(maxima, _step(info, 1.0), gradients, change)


def raise_in_torch(maxima: Maxima, step: Step, gradients: Tensor | None, change: Tensor | None) -> None:
    """The kernel's twin: the same in PyTorch."""
    (widths, errors, changes), (rows, radii, side, scales) = maxima, step
    seen = radii > 0
    widths.scatter_reduce_(0, rows, radii / side, "amax")
    if errors is not None:
        x, y = gradients.unbind(dim=-1)
        errors.scatter_reduce_(0, rows, torch.hypot(x * scales[0], y * scales[1]) * seen, "amax")
    if changes is not None:
        changes.scatter_reduce_(0, rows, change.where(seen, -math.inf), "amax")


def _kernels_take(info: Mapping[str, Any], *tensors: Tensor) -> bool:
    """Whether a kernel does it. Where one camera looks, no row of the state occurs twice."""
    device = tensors[0].device
    return (
        device.type == "cuda"
        and info["n_cameras"] == 1
        and all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in tensors)
        and try_kernel(device)
    )


@tried_once("What densification remembers")
def try_kernel(device: torch.device) -> None:
    """Whether the kernels run on a CUDA device; the first step would compile them."""
    from nrfgs_ns.densification.statistics_triton import add, raise_maxima

    one, two = torch.ones(1, device=device), torch.ones(1, 2, device=device)
    step = Step(torch.zeros(1, dtype=torch.int64, device=device), one.int(), 1.0, (1.0, 1.0))
    add({name: one.clone() for name in ("grad2d", "count", "radii")}, step, two)
    for errors, gradients in ((one.clone(), two), (None, None)):  # while splats grow, and after it
        raise_maxima(Maxima(one, errors, one.clone()), step, gradients, one)
