# SPDX-License-Identifier: Apache-2.0
"""Splats + colours + opacities -> image. gsplat 1.4's call, conventions and `info`, on the GPU and on the CPU.

Two stages, because colours and opacities come from an appearance head that should see visible splats only:

    projection = project(means, quats, scales, viewmats, Ks, width, height)      # which splats, where
    colors, opacities = head(projection.gaussian_ids, ...)                       # one row per visible splat
    render, alphas, info = composite(projection, colors, opacities)              # the image

The device of the means picks the back end: gsplat's kernels on CUDA, `torch_cpu` (plain torch, no compiler) on the CPU.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from .contract import Projection

__all__ = ["Projection", "changes_without", "composite", "contributions", "load_kernels", "project"]

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
_RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_RASTERIZE_MODES = ("classic", "antialiased")


def _backend(device: torch.device):
    """The module that projects and composites on a device. Imported late: the CPU path must never load CUDA code."""
    if device.type == "cuda":
        from . import gsplat_cuda

        return gsplat_cuda
    if device.type == "cpu":
        from . import torch_cpu

        return torch_cpu
    raise NotImplementedError(f"splats are on device {device}; the rasterizer runs on 'cuda' and 'cpu'")


def load_kernels(device: torch.device) -> None:
    """Have the compiled kernels of a CUDA device loaded, as the first picture would. A gsplat that came without them
    compiles them, once, for minutes."""
    _backend(device).load_kernels(device)


def _check_shape(name: str, tensor: Tensor, *shape: int) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} must have shape {list(shape)}, got {list(tensor.shape)}")


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    rasterize_mode: RasterizeMode = "classic",
    packed: bool = True,
    assume_finite: bool = False,
    every_row: bool = False,
) -> Projection:
    """Find the splats that each camera sees and project them. Differentiable in all tensors but Ks.

    Args:
        means: centres in world units. [N, 3]
        quats: rotations (w, x, y, z), not necessarily of unit length. [N, 4]
        scales: standard deviations along the splat's axes, in world units (not their logarithms). [N, 3]
        viewmats: world-to-camera transforms, x right, y down, z forward. [C, 4, 4]
        Ks: pinhole intrinsics in pixels, without skew. [C, 3, 3]
        width, height: image size in pixels.
        near_plane, far_plane: depths, inclusive, between which splats are visible. A splat whose projection is not
            finite (NaN or infinity in its mean or scale, a zero quaternion) is not visible either.
        radius_clip: splats whose radius is at most this many pixels are skipped.
        eps2d: blur added to the 2D covariances, in square pixels.
        rasterize_mode: "antialiased" also computes the opacity factor that compensates for the blur.
        packed: which of gsplat's projection kernels to follow. The rows come packed either way, but the two kernels
            put different floors into the radius formula, so a small round splat has radius 3 (packed) or 2 (not).
        assume_finite: do not look for splats that are not finite, which costs a GPU a wait. A training need not: its
            guard stops at the first such number.
        every_row: splats that are not visible are rows, too, of radius 0: then the host need not know how many are. For
            one camera, on CUDA.

    Raises:
        ValueError: a tensor has the wrong shape, or the mode is unknown.
        NotImplementedError: the device is neither CUDA nor CPU.
    """
    n, c = means.shape[0], viewmats.shape[0]
    for name, tensor, shape in (
        ("means", means, (n, 3)),
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("viewmats", viewmats, (c, 4, 4)),
        ("Ks", Ks, (c, 3, 3)),
    ):
        _check_shape(name, tensor, *shape)
    if rasterize_mode not in _RASTERIZE_MODES:
        raise ValueError(f"rasterize_mode must be one of {_RASTERIZE_MODES}, got {rasterize_mode!r}")
    how = {"every_row": True} if every_row else {"packed": packed, "assume_finite": assume_finite}
    return _backend(means.device).project(
        means,
        quats,
        scales,
        viewmats,
        Ks,
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        rasterize_mode=rasterize_mode,
        **how,
    )


def composite(
    projection: Projection,
    colors: Tensor,
    opacities: Tensor,
    *,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    tile_size: int = 16,
    absgrad: bool = False,
    assume_finite: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Blend the projected splats into images.

    Args:
        projection: the result of `project`, M rows.
        colors: any number of channels D per row; ignored by the modes "D" and "ED". [M, D]
        opacities: opacity per row, before antialiasing compensation. Below 1/255 nothing is drawn, nor is a row whose
            colour or opacity is not finite. [M]
            Both are brought to the precision of the projection: under autocast a head answers in half precision.
        backgrounds: colour behind the splats; depth is always composited over 0. [C, D]
        render_mode: channels of the render: colours, accumulated depth sum(w z) ("D"), expected depth sum(w z) / sum(w)
            ("ED"), or colours followed by one of the depths.
        tile_size: side in pixels of the tiles that cut a splat off beyond its radius, as in gsplat.
        absgrad: leave sum |dL/dmean2d| over pixels in `projection.means2d.absgrad` when going backward. [M, 2]
        assume_finite: as in `project`.

    Returns:
        render [C, H, W, X], alphas [C, H, W, 1], and gsplat's `info`: camera_ids, gaussian_ids, radii, means2d,
        depths, conics, opacities (compensated), width, height, tile_size, tile_width, tile_height, n_cameras; on CUDA
        also flatten_ids and isect_offsets, the lists of the splats that each tile draws.

    Raises:
        ValueError: a tensor has the wrong shape, or the mode is unknown.
    """
    m, c = projection.gaussian_ids.shape[0], projection.n_cameras
    _check_shape("opacities", opacities, m)
    _check_shape("colors", colors, m, colors.shape[-1])
    if render_mode not in _RENDER_MODES:
        raise ValueError(f"render_mode must be one of {_RENDER_MODES}, got {render_mode!r}")
    if backgrounds is not None:
        _check_shape("backgrounds", backgrounds, c, colors.shape[-1])

    colors, opacities = colors.to(projection.depths.dtype), opacities.to(projection.depths.dtype)
    backend = _backend(colors.device)
    leave_out = not assume_finite and backend.leaves_out(projection, colors, opacities, tile_size)
    if not assume_finite and not leave_out:
        # One such row would spread over every pixel that it covers, and from there into the gradients of all splats.
        drawable = torch.isfinite(colors.detach().sum(-1) + opacities.detach())
        colors, opacities = colors.where(drawable[:, None], 0.0), opacities.where(drawable, 0.0)
    if projection.compensations is not None:
        opacities = opacities * projection.compensations
    depths = projection.depths[:, None]
    if render_mode in ("D", "ED"):
        colors, backgrounds = depths, None
    elif render_mode in ("RGB+D", "RGB+ED"):
        colors = torch.cat([colors, depths], dim=-1)
        if backgrounds is not None:
            backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(c, 1)], dim=-1)

    render, alphas, lists = backend.composite(
        projection,
        colors,
        opacities,
        backgrounds=backgrounds,
        tile_size=tile_size,
        absgrad=absgrad,
        leave_out=leave_out,
    )
    if render_mode in ("ED", "RGB+ED"):
        render = torch.cat([render[..., :-1], render[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    info = {
        "camera_ids": projection.camera_ids,
        "gaussian_ids": projection.gaussian_ids,
        "radii": projection.radii,
        "means2d": projection.means2d,
        "depths": projection.depths,
        "conics": projection.conics,
        "opacities": opacities,
        "tile_width": -(-projection.width // tile_size),
        "tile_height": -(-projection.height // tile_size),
        **lists,
        "width": projection.width,
        "height": projection.height,
        "tile_size": tile_size,
        "n_cameras": c,
    }
    return render, alphas, info


def contributions(projection: Projection, opacities: Tensor) -> Tensor:
    """What each projected splat contributes to the image: the sum over its pixels p of w_i(p).

    w_i(p) = alpha_i(p) T_i(p) is the share of the pixel's light that comes from splat i: what `composite` multiplies
    its colour with, and so the derivative of the picture with respect to that colour. One forward and one backward pass
    through the rasterizer. No gradient flows through it.

    Args:
        projection: the result of `project`, M rows.
        opacities: per row, before antialiasing compensation, as for `composite`. [M]

    Returns:
        [M], in pixels.

    Raises:
        ValueError: a tensor has the wrong shape.
    """
    with torch.enable_grad():
        # The picture is linear in its colours: its derivative does not ask which they are.
        colors = projection.depths.new_zeros(len(opacities), 1).requires_grad_()
        render, _, _ = composite(projection, colors, opacities.detach())
        (shares,) = torch.autograd.grad(render.sum(), colors)
    return shares.squeeze(1)


def changes_without(
    projection: Projection,
    colors: Tensor,
    opacities: Tensor,
    counted: Tensor,
    generator: torch.Generator,
    *,
    backgrounds: Tensor | None = None,
    passes: int = 1,
) -> Tensor:
    """How much the images would change without each projected splat: the sum over pixels and channels of the squared
    change, in an estimate without bias.

    An image I is linear in the opacity o_i of each row, so that without that row alone it changes by -o_i dI/do_i. With
    signs r that are drawn anew for each pixel and channel, the mean of (o_i d(r I)/do_i)^2 is the sum that is wanted
    (Hutchinson): one backward pass says it of all rows. Its variance is at most twice its square, divided by the number
    of passes. Where a row's alpha is capped or below 1/255 at a pixel, it is taken to change nothing there.

    Args:
        projection: the result of `project`, M rows.
        colors, opacities, backgrounds: as for `composite`. [M, D], [M], [C, D]
        counted: which pixels count, 0 or 1. [C, H, W, 1]
        generator: of the signs, on the device of the projection.
        passes: how many times signs are drawn.

    Returns:
        [M], at least 0.

    Raises:
        ValueError: a tensor has the wrong shape.
    """
    _check_shape("counted", counted, projection.n_cameras, projection.height, projection.width, 1)
    opacities = opacities.detach().requires_grad_()
    with torch.enable_grad():
        render, _, _ = composite(projection, colors.detach(), opacities, backgrounds=backgrounds)
    total = torch.zeros_like(opacities, requires_grad=False)
    for left in reversed(range(passes)):
        signs = 2 * torch.randint(2, render.shape, generator=generator, device=render.device) - 1
        (slopes,) = torch.autograd.grad(render, opacities, signs * counted.to(render.dtype), retain_graph=left > 0)
        total += (opacities.detach() * slopes).square()
    return total / passes
