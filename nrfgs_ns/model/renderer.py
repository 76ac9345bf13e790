# SPDX-License-Identifier: Apache-2.0
"""Rendering as functions of values: camera -> geometry -> appearance -> rasterizer -> image.

seen_from = pinhole(camera, pose, downscale)                   # nerfstudio's camera as the rasterizer wants it
view = project_view(field.splats, seen_from, options)          # which splats, and where
appearance = field.seen_from(view)                             # their colours and opacities (`appearance/field.py`)
outputs, info = composite_view(view, appearance, background)   # the image
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor
from torch.nn.functional import normalize, pad

from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.data.checks import warn
from nrfgs_ns.rasterizer import Projection, ProjectionOptions, composite, project

REMEMBERED = 64
"""Cameras on a GPU whose conversion is remembered."""
NEAR_PLANE, FAR_PLANE = 0.01, 1e10
"""Depths between which splats are drawn, in scene units: splatfacto's."""


class Pinhole(NamedTuple):
    """One camera: gsplat's matrices, and its size on the host."""

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

    def rays(self) -> Tensor:
        """Unit directions from the centre through the pixels' centres, in world axes. [H, W, 3]"""
        x, y, z = self.viewmat[0, :3, :3]  # the camera's axes
        (fx, _, cx), (_, fy, cy), _ = self.K[0]
        across = (torch.arange(self.width, device=x.device, dtype=x.dtype) + 0.5 - cx) / fx
        down = (torch.arange(self.height, device=x.device, dtype=x.dtype) + 0.5 - cy) / fy
        rays = across[:, None] * x + down[:, None, None] * y + z
        return normalize(rays, dim=-1)


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


class Pinholes:
    """The cameras of one model, converted once; training cameras anew each time if an optimiser learns their poses."""

    def __init__(self, optimizer: CameraOptimizer | None = None):
        self._optimizer = optimizer
        self._of_training: dict[tuple[int, int], Pinhole] = {}  # by index and downscale
        # Cameras on a GPU, by the identity and version of their tensors, which stay alive.
        self._on_gpu: OrderedDict[tuple, tuple[list[Tensor], Pinhole]] = OrderedDict()
        self._has_warned = False

    def of_training(self, camera: Cameras, downscale: int) -> Pinhole:
        """A training camera at 1 / downscale of its size: a batch of one, [1], with its index "cam_idx" in its
        metadata, if it has one."""
        index = (camera.metadata or {}).get("cam_idx")
        if self._optimizer is not None:
            return pinhole(camera, self._optimizer.apply_to_camera(camera), downscale)
        if index is None:
            return pinhole(camera, camera.camera_to_worlds, downscale)
        if (index, downscale) not in self._of_training:
            self._of_training[index, downscale] = pinhole(camera, camera.camera_to_worlds, downscale)
        return self._of_training[index, downscale]

    def fixed(self, camera: Cameras, device: torch.device) -> Pinhole:
        """A camera of full size, a batch of one, [1] or without batch dimension, for a device.

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


def world_to_camera(camera_to_world: Tensor) -> Tensor:
    """World-to-camera matrices [C, 4, 4] (OpenCV: y down, z forwards) from nerfstudio's poses [C, 3, 4] (OpenGL)."""
    right, up_and_back, center = camera_to_world[:, :3].split([1, 2, 1], dim=2)
    rotation = torch.cat([right, -up_and_back], dim=2).transpose(1, 2)
    matrices = pad(torch.cat([rotation, -rotation @ center], dim=2), (0, 0, 0, 1))
    matrices[:, 3, 3] = 1.0
    return matrices


class View(NamedTuple):
    """Splats seen by one camera."""

    projection: Projection
    """the visible splats on the image plane, M of them"""
    center: Tensor
    """camera centre in world coordinates, [3]; of several cameras, each row's, [M, 3]"""
    every_row: bool = False
    """invisible splats have rows, too (`ProjectionOptions.every_row`)"""
    pinhole: Pinhole | None = None
    """the camera; None: the splats are those of several"""

    @property
    def visible(self) -> Tensor:
        """Rows of the table that are visible, int64 [M]."""
        return self.projection.gaussian_ids


def project_splats(
    splats: Mapping[str, Tensor], viewmats: Tensor, Ks: Tensor, width: int, height: int, options: ProjectionOptions
) -> Projection:
    """Project a table of splats ("scales" are logarithms) into cameras [C, 4, 4], [C, 3, 3] of one size."""
    geometry = splats["means"], splats["quats"], splats["scales"].exp()
    return project(*geometry, viewmats, Ks, width, height, options)


def project_view(splats: Mapping[str, Tensor], pinhole: Pinhole, options: ProjectionOptions) -> View:
    """Project a table of splats into one camera."""
    *camera, center = pinhole
    return View(project_splats(splats, *camera, options), center, options.every_row, pinhole)


def composite_view(
    view: View,
    appearance: SplatAppearance,
    background: Tensor,
    *,
    with_depth: bool = True,
    absgrad: bool = False,
    assume_finite: bool = False,
    image_of: Callable[[Tensor, Tensor], Tensor] | None = None,
    look: Callable[[Tensor], Tensor] | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Composite the visible splats over a background.

    Args:
        view: M visible splats.
        appearance: their colours and opacities.
        background: a colour [3].
        with_depth: return depth, too.
        absgrad, assume_finite: as in `rasterizer.composite`.
        image_of: of a head at the pixel (`AppearanceHead`). Features are composited over zero, and their image is drawn
            over the background, as opaque as the splats are. None: colours are the image's.
        look: the photograph's exposure model, applied to the rendered image [H, W, 3]; None: clamp it to [0, 1].

    Returns:
        "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [H, W, 3], and "depth" [H, W, 1] if wanted;
        and the rasterizer's `info`, for densification.
    """
    render, alpha, info = composite(
        view.projection,
        appearance.colors,
        appearance.opacities,
        backgrounds=background[None] if image_of is None else None,
        with_depth=with_depth,
        absgrad=absgrad,
        assume_finite=assume_finite,
    )
    render, alpha = render.squeeze(0), alpha.squeeze(0)  # the gradient of [0] would be a copy among zeros
    rgb = render[..., :-1] if with_depth else render
    if image_of is not None:
        rgb = alpha * image_of(rgb, view.pinhole.rays()) + (1.0 - alpha) * background
    outputs = {
        "rgb": torch.clamp(rgb, 0.0, 1.0) if look is None else look(rgb),
        "accumulation": alpha,
        "background": background.expand(*alpha.shape[:2], 3),
    }
    if with_depth:
        depth = render[..., -1:]
        outputs["depth"] = torch.where(alpha > 0, depth, depth.detach().max())
    return outputs, info
