# SPDX-License-Identifier: Apache-2.0
"""Splats + colours + opacities -> image, on the GPU and on the CPU, with gsplat 1.4's conventions and `info`.

Two stages, because colours and opacities come from an appearance head that should see visible splats only:

    view = project_view(field.splats, pinhole, options)            # which splats, and where
    appearance = field.seen_from(view)                             # colours and opacities, one row per visible splat
    outputs, info = composite_view(view, appearance, background)   # the image

`project` and `composite` are the same with gsplat's arguments. The device of the means picks the back end: gsplat's
kernels on CUDA, `torch_cpu` (plain torch, no compiler) on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from nrfgs_ns.appearance.head import SplatAppearance

Look = Callable[[Tensor], Tensor]
"""A photograph's exposure model: a rendered image [H, W, 3], not clamped -> as the photograph has it, in [0, 1]."""

EPS2D = 0.3
"""Blur added to the 2D covariances, in square pixels."""
TILE_SIZE = 16
"""Side, in pixels, of the tiles at whose borders a splat ends beyond its radius."""


@dataclass(frozen=True)
class ProjectionOptions:
    """Options of a projection. Its planes are splatfacto's where a scene unit is a world unit."""

    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    """classic: the blur makes splats wider. antialiased: it also makes them fainter, so that their light is kept"""
    near_plane: float = 0.01
    """smallest visible depth, in world units"""
    far_plane: float = 1e10
    """largest visible depth, in world units"""
    assume_finite: bool = False
    """do not check that splats are finite, which costs a GPU a wait; a training's guard finds those that are not"""
    every_row: bool = False
    """keep invisible splats as rows of radius 0, so that the number of rows is constant; one camera, on CUDA"""


@dataclass
class Projection:
    """Visible splats in gsplat's packed layout: one row per (camera, visible splat) pair, M rows, by camera, then by
    splat."""

    camera_ids: Tensor
    """Camera of each row. [M], int64"""
    gaussian_ids: Tensor
    """Splat of each row. [M], int64"""
    radii: Tensor
    """Half the side, in pixels, of the square of three standard deviations around the splat; 0 in invisible rows
    (`ProjectionOptions.every_row`). [M], int32"""
    means2d: Tensor
    """Projected centre in pixels; the top left pixel's centre is (0.5, 0.5). [M, 2]"""
    depths: Tensor
    """Camera-space z. [M]"""
    conics: Tensor
    """Upper triangle (xx, xy, yy) of the inverse of the blurred 2D covariance, in 1 / pixel^2. [M, 3]"""
    compensations: Tensor | None
    """Opacity factor sqrt(det / det_blurred), in [0, 1]; None in classic mode. [M]"""
    width: int
    height: int
    """Image size in pixels."""
    n_cameras: int
    extents: Tensor | None = None
    """Half the sides, in pixels, of the rectangle around each splat; gsplat 1.5's alone. [M, 2], int32"""


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
        return normalize(across[:, None] * x + down[:, None, None] * y + z, dim=-1)


def world_to_camera(camera_to_world: Tensor) -> Tensor:
    """World-to-camera matrices [C, 4, 4] (OpenCV: y down, z forwards) from poses [C, 3, 4] (OpenGL: y up, z back)."""
    right, up_and_back, center = camera_to_world[:, :3].split([1, 2, 1], dim=2)
    rotation = torch.cat([right, -up_and_back], dim=2).transpose(1, 2)
    matrices = pad(torch.cat([rotation, -rotation @ center], dim=2), (0, 0, 0, 1))
    matrices[:, 3, 3] = 1.0
    return matrices


class View(NamedTuple):
    """The splats that a camera, or each of several, sees."""

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


def _backend(device: torch.device, stage: str):
    """The module with a stage, "projection" or "compositing". Imported late: the CPU path must never load CUDA code."""
    if device.type not in ("cuda", "cpu"):
        raise NotImplementedError(f"splats are on device {device}; the rasterizer runs on 'cuda' and 'cpu'")
    return import_module(f"{__name__}.{'gsplat_cuda' if device.type == 'cuda' else f'torch_cpu.{stage}'}")


def load_kernels(device: torch.device) -> None:
    """Load a CUDA device's kernels now. A gsplat without compiled kernels compiles them, once, for minutes."""
    _backend(device, "projection").load_kernels(device)


def project_view(splats: Mapping[str, Tensor], pinhole: Pinhole, options: ProjectionOptions) -> View:
    """Project a table of splats into one camera: "means" [N, 3], "quats" [N, 4] and "scales" [N, 3], as logarithms."""
    *camera, center = pinhole
    projection = project(splats["means"], splats["quats"], splats["scales"].exp(), *camera, options)
    return View(projection, center, options.every_row, pinhole)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    options: ProjectionOptions = ProjectionOptions(),  # noqa: B008
) -> Projection:
    """Find the splats that each camera sees and project them. Differentiable in all tensors but Ks.

    A splat is visible if its depth lies between the planes (inclusive), its square touches the image, and its
    projection is finite: no NaN or infinity in its mean or scales, no zero quaternion.

    Args:
        means: centres in world units, on a CUDA device or the CPU. [N, 3]
        quats: rotations (w, x, y, z), not necessarily of unit length. [N, 4]
        scales: standard deviations along the splat's axes, in world units (not their logarithms). [N, 3]
        viewmats: world-to-camera transforms, x right, y down, z forward. [C, 4, 4]
        Ks: pinhole intrinsics in pixels, without skew. [C, 3, 3]
        width, height: image size in pixels.
    """
    return _backend(means.device, "projection").project((means, quats, scales), (viewmats, Ks, width, height), options)


def composite_view(
    view: View,
    appearance: SplatAppearance,
    background: Tensor,
    *,
    with_depth: bool = True,
    absgrad: bool = False,
    assume_finite: bool = False,
    image_of: Callable[[Tensor, Tensor], Tensor] | None = None,
    look: Look | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Composite the visible splats over a background.

    Args:
        view: M visible splats.
        appearance: their colours and opacities.
        background: a colour [3].
        with_depth: return depth, too.
        absgrad, assume_finite: as in `composite`.
        image_of: a head at the pixel's (`AppearanceHead.image_of`). Features are composited over zero, and the image of
            them is drawn over the background with the splats' accumulated opacity. None: colours are the image's.
        look: the photograph's; None: clamp the rendered image to [0, 1].

    Returns:
        "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [H, W, 3], and "depth" [H, W, 1] if wanted;
        and the rasterizer's `info`, for densification.
    """
    behind = background[None] if image_of is None else None
    options = {"with_depth": with_depth, "absgrad": absgrad, "assume_finite": assume_finite}
    render, alpha, info = composite(view.projection, *appearance, backgrounds=behind, **options)
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


def composite(
    projection: Projection,
    colors: Tensor,
    opacities: Tensor,
    *,
    backgrounds: Tensor | None = None,
    with_depth: bool = False,
    absgrad: bool = False,
    assume_finite: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Blend the projected splats into images.

    Args:
        projection: the result of `project`, M rows.
        colors: any number of channels D per row. [M, D]
        opacities: opacity per row, before antialiasing compensation. [M]
            Rows below 1/255, or whose colour or opacity is not finite, are not drawn. Both tensors are converted to the
            projection's precision: under autocast a head computes in half precision.
        backgrounds: colour behind the splats. [C, D]
        with_depth: append expected depth, sum(w z) / sum(w), to the colours: gsplat's mode "RGB+ED".
        absgrad: leave sum |dL/dmean2d| over pixels in `projection.means2d.absgrad` when going backward. [M, 2]
        assume_finite: do not check that rows are finite.

    Returns:
        render [C, H, W, D or D + 1], alphas [C, H, W, 1], and gsplat's `info`: camera_ids, gaussian_ids, radii,
        means2d, depths, conics, opacities (compensated), width, height, tile_size, tile_width, tile_height, n_cameras;
        on CUDA also flatten_ids and isect_offsets, the lists of the splats that each tile draws.
    """
    colors, opacities = colors.to(projection.depths.dtype), opacities.to(projection.depths.dtype)
    if not assume_finite:
        # A row that is not finite would spread over every pixel that it covers, and on into all splats' gradients.
        drawable = torch.isfinite(colors.detach().sum(-1) + opacities.detach())
        colors, opacities = colors.where(drawable[:, None], 0.0), opacities.where(drawable, 0.0)
    if projection.compensations is not None:
        opacities = opacities * projection.compensations
    if with_depth:
        colors = torch.cat([colors, projection.depths[:, None]], dim=-1)
        if backgrounds is not None:
            backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(len(backgrounds), 1)], dim=-1)

    backend = _backend(colors.device, "compositing")
    render, alphas, lists = backend.composite(projection, colors, opacities, backgrounds, absgrad)
    if with_depth:
        render = torch.cat([render[..., :-1], render[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    keys = "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "width", "height", "n_cameras"
    info = {key: getattr(projection, key) for key in keys} | {"opacities": opacities, "tile_size": TILE_SIZE} | lists
    info |= {f"tile_{side}": -(-info[side] // info["tile_size"]) for side in ("width", "height")}
    return render, alphas, info


def contributions(projection: Projection, opacities: Tensor) -> Tensor:
    """Contribution of each projected splat to the image: the sum of w_i(p) over its pixels p, [M], in pixels.

    w_i(p) = alpha_i(p) T_i(p) is splat i's share of the pixel's light, and so the image's derivative with respect to
    the splat's colour: one forward and one backward pass. The result has no gradient.

    Args:
        projection: the result of `project`, M rows.
        opacities: per row, before antialiasing compensation, as for `composite`. [M]
    """
    with torch.enable_grad():
        # The image is linear in its colours: its derivative is the same for all.
        colors = projection.depths.new_zeros(len(opacities), 1).requires_grad_()
        render, _, _ = composite(projection, colors, opacities.detach())
        (shares,) = torch.autograd.grad(render.sum(), colors)
    return shares.squeeze(1)
