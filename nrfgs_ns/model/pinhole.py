# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's cameras as the rasterizer wants them."""

from functools import lru_cache
from typing import NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor


class Pinhole(NamedTuple):
    """One camera: gsplat's matrices, and sizes that the host knows without asking the GPU."""

    viewmat: Tensor
    """world-to-camera, x right, y down, z forward. [1, 4, 4]"""
    K: Tensor
    """intrinsics in pixels. [1, 3, 3]"""
    width: int
    """pixels"""
    height: int
    """pixels"""
    center: Tensor
    """camera centre in world coordinates. [3]"""


def pinhole(camera: Cameras, camera_to_world: Tensor, downscale: int) -> Pinhole:
    """One camera, at 1 / downscale of its size, rounded down as its image is.

    Args:
        camera: a batch of one, [1] or without batch dimension. Reading its size waits for the GPU if it lies there.
        camera_to_world: its pose, [1, 3, 4], with y up and z backwards (OpenGL); perhaps with a learnt correction.
    """
    K = camera.get_intrinsics_matrices().reshape(1, 3, 3).to(camera_to_world.device)
    K = K / K.new_tensor([[downscale], [downscale], [1.0]])
    width, height = int(camera.width.item()) // downscale, int(camera.height.item()) // downscale
    center = camera_to_world[0, :3, 3].contiguous()  # so that no kernel has to copy it
    return Pinhole(world_to_camera(camera_to_world), K, width, height, center)


def world_to_camera(camera_to_world: Tensor) -> Tensor:
    """World-to-camera matrices from nerfstudio's poses.

    Args:
        camera_to_world: [C, 3, 4], with y up and z backwards (OpenGL).

    Returns:
        [C, 4, 4], with y down and z forwards (OpenCV, gsplat).
    """
    flip, last = _constants(camera_to_world.device, camera_to_world.dtype)
    rotation = (camera_to_world[:, :3, :3] * flip).transpose(1, 2)
    translation = -rotation @ camera_to_world[:, :3, 3:4]
    return torch.cat([torch.cat([rotation, translation], dim=2), last.expand(len(camera_to_world), 1, 4)], dim=1)


@lru_cache
def _constants(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The flip of y and z, and a matrix's last row; made once, since a copy to the GPU waits for it."""
    with torch.inference_mode(False):  # they outlive a rendering that records nothing
        flip = torch.tensor([1.0, -1.0, -1.0], device=device, dtype=dtype)
        return flip, torch.tensor([0.0, 0.0, 0.0, 1.0], device=device, dtype=dtype)
