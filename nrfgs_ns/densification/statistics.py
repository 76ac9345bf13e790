# SPDX-License-Identifier: Apache-2.0
"""What growth by gradients remembers of each step: how much splats wanted to move on the screen, and how large they
were. On CUDA one Triton kernel does it (`statistics_triton.py`), elsewhere and for several cameras PyTorch does."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nrfgs_ns.kernels.trial import Gate


def take_statistics(state: Mapping[str, Tensor], info: Mapping[str, Any], gradients: Tensor) -> None:
    """Add a step's screen-space gradients, in an image of [-1, 1], and radii, in shares of the longer side.

    Args:
        state: "grad2d" and "count" [N], and "radii" [N] if they are wanted: written to.
        info: the rasterizer's; M rows, those of radius 0 of splats that are not visible.
        gradients: of the loss by the rows' centres, in pixels, [M, 2].
    """
    scales = info["width"] / 2.0 * info["n_cameras"], info["height"] / 2.0 * info["n_cameras"]
    side = float(max(info["width"], info["height"]))
    if _kernel_takes(state, info, gradients):
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


_GATE = Gate("What densification remembers")


def _kernel_takes(state: Mapping[str, Tensor], info: Mapping[str, Any], gradients: Tensor) -> bool:
    """Whether the kernel does it. Where one camera looks, no row of the state occurs twice."""
    device = gradients.device
    tensors = gradients, *(state[name] for name in ("grad2d", "count", "radii") if name in state)
    return (
        device.type == "cuda"
        and info["n_cameras"] == 1
        and all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in tensors)
        and try_kernel(device)
    )


def try_kernel(device: torch.device) -> bool:
    """Whether the kernel runs on a CUDA device; tried once, which compiles it: the first step would."""
    return _GATE.opens(device, device, lambda: _try_kernel(device))


def _try_kernel(device: torch.device) -> None:
    """Compile and run the kernel on one splat; raise whatever goes wrong."""
    from nrfgs_ns.densification.statistics_triton import add

    row, one = torch.zeros(1, dtype=torch.int64, device=device), torch.ones(1, device=device)
    add(one, one.clone(), one.clone(), row, torch.ones(1, 2, device=device), one.int(), (1.0, 1.0), 1.0)
