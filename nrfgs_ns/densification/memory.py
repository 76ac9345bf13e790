# SPDX-License-Identifier: Apache-2.0
"""How many splats a GPU has memory for."""

import sys
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim import Optimizer

SHARE = 0.9
"""Share of the memory that growth may fill: free memory is in pieces, and views differ in what they need."""
PLENTY = 0.25
"""Share of the memory up to which torch may keep what it does not use."""
BYTES_PER_PIXEL = 200
"""Bytes that a step needs for a pixel: the image, the photograph and SSIM's means of both, with their gradients."""


def allowed(device: torch.device) -> int:
    """Bytes of a GPU that this process may take; 0 on a CPU."""
    if device.type != "cuda":
        return 0
    # torch < 2.8 does not say what `set_per_process_memory_fraction` was given.
    share = getattr(torch.cuda, "get_per_process_memory_fraction", lambda _: 1.0)(device)
    return int(share * torch.cuda.get_device_properties(device).total_memory)


def most_splats(splats: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer], later_pixels: int) -> int:
    """The most splats that a refinement may grow to; no limit on a CPU, and where there are none yet.

    A splat is taken to need what each of the N present ones needs now, for parameters, gradients, moments and a step's
    other tensors and lists; while rows are added, parameters and moments also exist a second time (`copied`). So

        most = N (SHARE * available - fixed - BYTES_PER_PIXEL * later_pixels) / (reserved - fixed + copied),

    with `reserved` the bytes that torch has, and `fixed` those that do not grow with the splats.

    Args:
        later_pixels: pixels that the training's largest image has more than the present ones.
    """
    device = splats["means"].device
    count = len(splats["means"])
    if device.type != "cuda" or count == 0:
        return sys.maxsize
    moments = [value for name in splats for value in optimizers[name].state.get(splats[name], {}).values()]
    parameters = sum(value.nbytes for value in splats.values())
    copied = parameters + sum(value.nbytes for value in moments if value.dim() > 0)
    # Photographs, for the most part; also what several graphs leave. Gradients take as much as parameters.
    fixed = max(torch.cuda.memory_allocated(device) - copied - parameters, 0)
    room = SHARE * available(device) - fixed - BYTES_PER_PIXEL * later_pixels
    return max(int(count * room / (torch.cuda.memory_reserved(device) - fixed + copied)), 0)


def available(device: torch.device) -> int:
    """Bytes of a GPU that torch has in this process, or may still get beside other processes."""
    free, _ = torch.cuda.mem_get_info(device)
    return min(torch.cuda.memory_reserved(device) + free, allowed(device))


def share_used(device: torch.device) -> float:
    """Share of a GPU's available memory that torch has; 0 on a CPU."""
    return torch.cuda.memory_reserved(device) / available(device) if device.type == "cuda" else 0.0


def give_back(device: torch.device) -> None:
    """Give back what torch keeps of a GPU for later: `most_splats` counts it as in use, and a graph that is being
    recorded does not get it. Nothing where memory is plentiful, since it costs time to get it again."""
    if share_used(device) > PLENTY:
        torch.cuda.empty_cache()
