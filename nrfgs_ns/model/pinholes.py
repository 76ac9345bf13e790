# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's cameras as the rasterizer wants them."""

from collections import OrderedDict

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from nrfgs_ns.data.checks import warn
from nrfgs_ns.rasterizer import Pinhole, world_to_camera

REMEMBERED = 64
"""Cameras on a GPU whose conversion is remembered."""


class Pinholes:
    """Cameras of full size, converted once."""

    def __init__(self):
        # Cameras on a GPU, by the identity and version of their tensors, which stay alive.
        self._on_gpu: OrderedDict[tuple, tuple[list[Tensor], Pinhole]] = OrderedDict()
        self._has_warned = False

    def of_full_size(self, camera: Cameras, device: torch.device) -> Pinhole:
        """A camera of full size, a batch of one, [1] or without batch dimension, on a device.

        A camera in host memory costs no wait. To read one on the GPU the host waits for all work there, so the last
        `REMEMBERED` ones are kept until something writes to them.
        """
        sizes = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        fields = [camera.camera_to_worlds, *sizes, camera.camera_type]
        if not fields[0].is_cuda or any(field.is_inference() for field in fields):
            return self._converted(fields, device)
        key = device, *((id(field), field._version) for field in fields)
        if key not in self._on_gpu:
            self._on_gpu[key] = fields, self._converted(fields, device)
            if len(self._on_gpu) > REMEMBERED:
                self._on_gpu.popitem(last=False)
        return self._on_gpu[key][1]

    def _converted(self, fields: list[Tensor], device: torch.device) -> Pinhole:
        """A pinhole computed on the host and sent to a device in one piece."""
        # float64 holds sizes and float32 alike.
        pose, sizes = torch.cat([field.reshape(-1).double() for field in fields]).cpu().split([12, 7])
        fx, fy, cx, cy, width, height, kind = sizes.tolist()
        if kind != CameraType.PERSPECTIVE.value and not self._has_warned:
            warn(f"Cameras of the type {CameraType(int(kind)).name.lower()} are drawn as pinholes.")
            self._has_warned = True
        pose = pose.float().view(1, 3, 4)
        with torch.inference_mode(False):  # it outlives a rendering that records nothing
            whole = torch.zeros(32)  # each part at a multiple of 16 bytes, as Triton's kernels like it
            whole[:16] = world_to_camera(pose).flatten()
            whole[16:25] = torch.tensor([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
            whole[28:31] = pose[0, :, 3]
            whole = whole.to(device, non_blocking=True)
            return Pinhole(whole[:16].view(1, 4, 4), whole[16:25].view(1, 3, 3), int(width), int(height), whole[28:31])


def pinhole(camera: Cameras, camera_to_world: Tensor, downscale: int) -> Pinhole:
    """One camera, at 1 / downscale of its size, rounded down as its image is.

    Args:
        camera: a batch of one, [1] or without batch dimension. If it is on a GPU, its size is waited for.
        camera_to_world: its pose, [1, 3, 4], with y up and z backwards (OpenGL), and any learnt correction.
    """
    K = camera.get_intrinsics_matrices().reshape(1, 3, 3).to(camera_to_world.device)
    K = K / K.new_tensor([[downscale], [downscale], [1.0]])
    width, height = int(camera.width.item()) // downscale, int(camera.height.item()) // downscale
    center = camera_to_world[0, :3, 3].contiguous()  # so that no kernel has to copy it
    return Pinhole(world_to_camera(camera_to_world), K, width, height, center)
