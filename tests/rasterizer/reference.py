# SPDX-License-Identifier: Apache-2.0
"""The slow twin: the same image from dense float64 arithmetic, every splat against every pixel, gradients by autograd.

It is written to be checked by eye against the definition, and shares no code with the fast path. Arrays are [N, H, W]
for one camera, so images must be small. Cut-offs (1/255, 1e-4, 0.999, the radius and its tiles) are steps, and float32
may fall on the other side: `Image` says at which pixels that can happen, and how far they can move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, TILE_SIZE = 1 / 255, 0.999, 1e-4, 16
HELD = 4.0
"""Pixels. The arithmetic to be judged may hold positions about the centre of a tile this far from its sides: positions
and their products then lose roundings of HELD and of HELD^2, however near a pixel is to a splat's centre."""


@dataclass
class Screen:
    """N splats seen by one camera; rows of invisible splats are meaningless. float64"""

    means2d: Tensor  # [N, 2]
    depths: Tensor  # [N]
    conics: Tensor  # [N, 2, 2], inverse of the blurred covariance
    compensations: Tensor  # [N], sqrt(det / det_blurred)
    condition: Tensor  # [N], a c / det before the blur: by how much a difference of products amplifies rounding in det
    reach: Tensor  # [N, 2], half the sides of the splat's rectangle before they are rounded up
    visible: Tensor  # [N], bool


@dataclass
class Image:
    """One camera's image, and bounds to judge another one by. float64"""

    render: Tensor  # [H, W, D]
    alphas: Tensor  # [H, W, 1]
    order: Tensor  # [n], int64: the n visible splats, nearest first
    pixel_means2d: Tensor  # [n, H, W, 2], means2d[order] for each pixel: absgrad is the sum over pixels of its |.grad|
    rounding: Tensor  # [H, W], first-order bound of the rounding error in `unit`s, per unit of colour range
    undecided: Tensor  # [H, W], bool: pixels where a cut-off lies within rounding error
    jump: Tensor  # [H, W], how far an undecided pixel may move per unit of colour range


def project(
    *arguments: Any,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    floor: float = 0.1,
    bounds: Literal["square", "rectangle"] = "square",
) -> Screen:
    """Project N splats into one camera: cov2d = J W Sigma W^T J^T + eps2d I. Everything in float64.

    Args:
        floor: under the root of the eigenvalue formula: 0.1 in gsplat 1.4's packed kernel, 0.01 in its dense one.
        bounds: what cuts a splat off. square: of three standard deviations along its longest axis, as gsplat 1.4 does
            it. rectangle: of 3.33 along each axis of the image, as gsplat 1.5.
    """
    *tables, width, height = arguments
    means, quats, scales, viewmat, K = (t.double() for t in tables)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    W, t = viewmat[:3, :3], viewmat[:3, 3]

    points = means @ W.T + t
    depths = points[:, 2]
    # Splats behind the camera are computed at depth 1 and marked invisible, so that no infinity enters a gradient.
    in_range = (depths >= near_plane) & (depths <= far_plane)
    x, y, z = torch.where(in_range[:, None], points, torch.ones_like(points)).unbind(-1)

    w, i, j, k = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    R = torch.stack(
        [
            torch.stack([1 - 2 * (j**2 + k**2), 2 * (i * j - w * k), 2 * (i * k + w * j)], -1),
            torch.stack([2 * (i * j + w * k), 1 - 2 * (i**2 + k**2), 2 * (j * k - w * i)], -1),
            torch.stack([2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i**2 + j**2)], -1),
        ],
        -2,
    )
    sigma_world = R @ torch.diag_embed(scales**2) @ R.mT

    slack_x, slack_y = 0.3 * width / (2 * fx), 0.3 * height / (2 * fy)
    u = (x / z).clamp(-cx / fx - slack_x, (width - cx) / fx + slack_x)
    v = (y / z).clamp(-cy / fy - slack_y, (height - cy) / fy + slack_y)
    zero = torch.zeros_like(z)
    J = torch.stack([torch.stack([fx / z, zero, -fx * u / z], -1), torch.stack([zero, fy / z, -fy * v / z], -1)], -2)

    cov2d = J @ W @ sigma_world @ W.T @ J.mT
    blurred = cov2d + eps2d * torch.eye(2, dtype=torch.float64)
    ratio = (torch.linalg.det(cov2d) / torch.linalg.det(blurred)).clamp(min=0)
    # sqrt(ratio) with the slope that gsplat gives it, 1 / (2 (sqrt + 1e-6)): finite at 0.
    root = ratio.detach().sqrt()
    compensations = root + (ratio - ratio.detach()) / (2 * (root + 1e-6))
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)

    condition = (cov2d[:, 0, 0] * cov2d[:, 1, 1] / torch.linalg.det(cov2d).clamp(min=1e-300)).detach()

    variances = torch.diagonal(blurred, dim1=-2, dim2=-1)
    half_trace = 0.5 * (blurred[:, 0, 0] + blurred[:, 1, 1])
    longest = half_trace + (half_trace**2 - torch.linalg.det(blurred)).clamp(min=floor).sqrt()
    reach = 3.33 * variances.sqrt() if bounds == "rectangle" else 3 * longest.sqrt()[:, None].expand(-1, 2)
    sides, size = reach.ceil(), torch.tensor([width, height])
    visible = in_range & ((means2d + sides > 0) & (means2d - sides < size)).all(-1) & (sides.amax(-1) > 0)
    return Screen(means2d, depths, torch.linalg.inv(blurred), compensations, condition, reach, visible)


def _covered(centre: Tensor, radius: Tensor, n_pixels: int) -> Tensor:
    """Whether each pixel of an axis lies in a tile that [centre - radius, centre + radius] meets. [N, n_pixels]"""
    tile = torch.arange(n_pixels) // TILE_SIZE
    first = ((centre - radius) / TILE_SIZE).floor()[:, None]
    return (tile >= first) & (tile < ((centre + radius) / TILE_SIZE).ceil()[:, None])


def composite(
    screen: Screen,
    colors: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    unit: float = 2.0**-24,
    opacity_error: Tensor | float = 0.0,
    order: Tensor | None = None,
    perturb: Callable[[Tensor], Tensor] = lambda t: t,
) -> Image:
    """Blend N splats into one image.

    Args:
        opacities: as composited, compensation included. [N]
        unit: rounding unit of the arithmetic that will be compared (float32 by default); it shapes `rounding`,
            `undecided` and `jump` only, never the image.
        opacity_error: relative error of the opacities beyond rounding, in the same role. [N]
        order: visible splats from front to back, where noise in the depths must not break ties; by default, sorted. [n]
        perturb: see `rasterization`.
    """

    def held(t: Tensor, size: float) -> Tensor:
        return t + (perturb(torch.full_like(t, size)) - size)

    if order is None:
        order = torch.argsort(screen.depths.detach(), stable=True)
        order = order[screen.visible[order]]
    opacity_error = torch.as_tensor(opacity_error).expand_as(screen.depths)[order, None, None]
    means2d, conics, sides = screen.means2d[order], screen.conics[order], screen.reach[order].detach()
    opacities, colors = opacities.double()[order, None, None], colors.double()[order]

    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixel_means2d = means2d[:, None, None, :].expand(-1, height, width, -1)
    if pixel_means2d.requires_grad:
        pixel_means2d = pixel_means2d.clone()
        pixel_means2d.retain_grad()
    d = held(torch.stack([x, y], -1).double() - pixel_means2d, HELD)  # [n, H, W, 2]
    sigma = 0.5 * torch.einsum("nij,nhwij->nhw", conics, held(d[..., :, None] * d[..., None, :], HELD**2))
    raw = opacities * torch.exp(-sigma)

    def reach(sides: Tensor, shift: Tensor | float = 0.0) -> Tensor:
        columns = _covered(means2d[:, 0].detach(), sides[:, 0] + shift, width)
        rows = _covered(means2d[:, 1].detach(), sides[:, 1] + shift, height)
        return rows[:, :, None] & columns[:, None, :]

    within = reach(sides.ceil())
    counts = within & (raw >= MIN_ALPHA)
    alpha = torch.where(counts, raw.clamp(max=MAX_ALPHA), 0.0)
    after = torch.cumprod(1 - alpha, dim=0)
    drawn = after > MIN_TRANSMITTANCE
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = torch.where(drawn, alpha * before, 0.0)
    transmittance = torch.where(drawn, 1 - alpha, 1.0).prod(0)
    render = torch.einsum("nhw,nd->hwd", weights, colors)
    if background is not None:
        render = render + transmittance[..., None] * background.double()

    with torch.no_grad():
        # Error of l in roundings: 8 in opacity and exp; 8 in each entry of the conic, whose terms may cancel; 8 in the
        # determinant as a difference of products (a c / det of them); 8 in positions, times the slope of sigma there;
        # 8 in the products of positions about a tile's centre.
        terms = 0.5 * torch.einsum("nhwi,nij,nhwj->nhw", d.abs(), conics.abs(), d.abs())
        cancelled = (conics[:, 0, 0] * conics[:, 1, 1] / torch.linalg.det(conics))[:, None, None]
        slope = torch.einsum("nij,nhwj->nhwi", conics, d).abs().sum(-1)
        where = means2d.abs().amax(-1)[:, None, None] + max(width, height)
        products = 0.5 * HELD**2 * conics.abs().sum((1, 2))[:, None, None]
        error = 8 * unit * (1 + terms + cancelled * sigma + slope * where + products) + opacity_error
        rounding = 2 * (weights * error).sum(0) + 8 * unit
        lost = torch.cumsum(torch.where(counts, alpha / (1 - alpha) * error, 0.0), 0) + 8 * unit  # relative error of T

        longest = sides.amax(-1)
        fuzz = 8 * unit * (longest * (1 + cancelled[:, 0, 0]) + means2d.abs().amax(-1) + max(width, height))
        may_reach = reach((sides + fuzz[:, None]).ceil(), fuzz) != reach((sides - fuzz[:, None]).ceil(), -fuzz)
        near_min = (raw / MIN_ALPHA - 1).abs() <= error
        reached = torch.cat([torch.ones_like(drawn[:1]), drawn[:-1]])
        maybe_cut = reached & ((within & near_min) | (may_reach & (raw >= MIN_ALPHA * (1 - error))))
        maybe_capped = reached & within & ((raw / MAX_ALPHA - 1).abs() <= error)
        maybe_ended = reached & counts & ((after / MIN_TRANSMITTANCE - 1).abs() <= lost)
        jump = (torch.where(maybe_cut, raw.clamp(max=MAX_ALPHA), 0.0) * before).sum(0)
        jump = 2 * jump + 2 * torch.where(maybe_ended, before, 0.0).sum(0)
        undecided = (maybe_cut | maybe_capped | maybe_ended).any(0)

    return Image(render, 1 - transmittance[..., None], order, pixel_means2d, rounding, undecided, jump)


def rasterization(
    *arguments: Any,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    unit: float = 2.0**-24,
    perturb: Callable[[Tensor], Tensor] = lambda t: t,
    orders: list[Tensor] | None = None,
    **limits: Any,
) -> tuple[Tensor, Tensor, list[Screen], list[Image]]:
    """The twin of `gsplat_call.rasterization`, camera by camera.

    Args:
        perturb: applied to the projected means, depths, conics and compensations, to pixels' offsets and their products
            (`HELD`), and to the transmittance that expected depth is divided by; with noise of a few rounding units it
            shows what rounding does to the image and to its gradients.
        orders: see `composite`; one per camera.

    Returns:
        render [C, H, W, X], alphas [C, H, W, 1], and the screens and images of the C cameras.
    """
    means, quats, scales, opacities, colors, viewmats, Ks, width, height = arguments
    renders, screens, images = [], [], []
    for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        screen = project(means, quats, scales, viewmat, K, width, height, **limits)
        noisy = {name: perturb(getattr(screen, name)) for name in ("means2d", "depths", "conics")}
        noise = (perturb(screen.compensations) - screen.compensations) * (1 + screen.condition)
        screen = replace(screen, **noisy, compensations=screen.compensations + noise)
        color = (colors[camera] if colors.dim() == 3 else colors).double()
        background = None if backgrounds is None else backgrounds[camera].double()
        depths = screen.depths[:, None]
        if render_mode == "RGB+ED":
            color = torch.cat([color, depths], -1)
            background = None if background is None else torch.cat([background, background.new_zeros(1)])
        opacity, opacity_error = opacities, 0.0
        if rasterize_mode == "antialiased":
            opacity, opacity_error = opacities.double() * screen.compensations, 8 * unit * screen.condition
        order = None if orders is None else orders[camera]
        errors = {"unit": unit, "opacity_error": opacity_error, "order": order, "perturb": perturb}
        image = composite(screen, color, opacity, width, height, background=background, **errors)
        render = image.render
        if render_mode == "RGB+ED":
            alphas = 1 - perturb(1 - image.alphas)
            render = torch.cat([render[..., :-1], render[..., -1:] / alphas.clamp(min=1e-10)], -1)
        renders.append(render)
        screens.append(screen)
        images.append(image)
    return torch.stack(renders), torch.stack([image.alphas for image in images]), screens, images
