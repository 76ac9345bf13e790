# SPDX-License-Identifier: Apache-2.0
"""What growth remembers of each step: how much splats wanted to move on the screen, how large they were, and how much
the view changed their opacity. Growth by gradients adds it up, growth by error keeps the largest.

On CUDA a Triton kernel for sums and one for maxima do it (`statistics_triton.py`), elsewhere and for several cameras
PyTorch does.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nrfgs_ns.kernels.trial import tried_once


def take_statistics(state: Mapping[str, Tensor], info: Mapping[str, Any], gradients: Tensor) -> None:
    """Add a step's screen-space gradients, in an image of [-1, 1], and radii, in shares of the longer side.

    Args:
        state: "grad2d" and "count" [N], and "radii" [N] if they are wanted: written to.
        info: the rasterizer's; M rows, those of radius 0 of splats that are not visible.
        gradients: of the loss by the rows' centres, in pixels, [M, 2].
    """
    scales = info["width"] / 2.0 * info["n_cameras"], info["height"] / 2.0 * info["n_cameras"]
    side = float(max(info["width"], info["height"]))
    if _kernels_take(info, gradients, *(state[name] for name in ("grad2d", "count", "radii") if name in state)):
        from nrfgs_ns.densification.statistics_triton import add

        rows, radii = info["gaussian_ids"], info["radii"]
        add(state["grad2d"], state["count"], state.get("radii"), rows, gradients, radii, scales, 1.0 / side)
    else:
        add_in_torch(state, info["gaussian_ids"], gradients, info["radii"], scales, side)


def add_in_torch(
    state: Mapping[str, Tensor],
    rows: Tensor,
    gradients: Tensor,
    radii: Tensor,
    scales: tuple[float, float],
    side: float,
) -> None:
    """The kernel's twin: the same in PyTorch.

    Args:
        rows: of the state, [M].
        radii: in pixels, [M]; 0 where a row is not to count.
        scales: what the gradients are multiplied by.
        side: what the radii are divided by.
    """
    visible = radii > 0
    gradients = gradients.clone()
    gradients[:, 0] *= scales[0]
    gradients[:, 1] *= scales[1]
    norms = gradients.norm(dim=-1) * visible
    state["grad2d"].index_add_(0, rows, norms)
    state["count"].index_add_(0, rows, visible.to(norms.dtype))
    if "radii" in state:
        state["radii"][rows] = torch.maximum(state["radii"][rows], radii / side)


def take_maxima(
    widths: Tensor,
    errors: Tensor | None,
    changes: Tensor | None,
    info: Mapping[str, Any],
    gradients: Tensor | None,
    change: Tensor | None,
) -> None:
    """Let the maxima be at least a step's radii, in shares of the longer side, the norms of its screen-space gradients,
    in an image of [0, 1], and its changes of opacity. Radii and norms are never below 0.

    Args:
        widths, errors, changes: maxima [N], written to; None: not wanted.
        info: the rasterizer's, as in `take_statistics`.
        gradients: of the loss by the rows' centres, in pixels, [M, 2].
        change: of the rows' opacities, [M].
    """
    scales = float(info["width"] * info["n_cameras"]), float(info["height"] * info["n_cameras"])
    side = float(max(info["width"], info["height"]))
    rows, radii = info["gaussian_ids"], info["radii"]
    if _kernels_take(info, *(value for value in (widths, errors, changes, gradients, change) if value is not None)):
        from nrfgs_ns.densification.statistics_triton import raise_maxima

        raise_maxima(widths, errors, changes, rows, radii, gradients, change, 1.0 / side, scales)
    else:
        raise_in_torch(widths, errors, changes, rows, radii, gradients, change, side, scales)


def raise_in_torch(
    widths: Tensor,
    errors: Tensor | None,
    changes: Tensor | None,
    rows: Tensor,
    radii: Tensor,
    gradients: Tensor | None,
    change: Tensor | None,
    side: float,
    scales: tuple[float, float],
) -> None:
    """The kernel's twin: the same in PyTorch, with radii in pixels that are divided by `side`."""
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

    row, one = torch.zeros(1, dtype=torch.int64, device=device), torch.ones(1, device=device)
    two = torch.ones(1, 2, device=device)
    add(one, one.clone(), one.clone(), row, two, one.int(), (1.0, 1.0), 1.0)
    for errors, gradients in ((one.clone(), two), (None, None)):  # while splats grow, and after it
        raise_maxima(one, errors, one.clone(), row, one.int(), gradients, one, 1.0, (1.0, 1.0))
