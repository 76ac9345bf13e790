# SPDX-License-Identifier: Apache-2.0
"""Points from the photographs themselves, where the capture's own are few: a plane sweep.

For each view a few others that see the same points from other places are warped onto planes parallel to its image
(Collins 1996). Each pixel takes the plane on which they agree best by normalised cross-correlation, which does not
depend on exposure. A depth counts where two other views find the same.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

SIDE = 256
"""Longer side of the images that are compared, in pixels."""
SOURCES = 6
"""Other views that a view is compared with; the better half of them decides at each pixel."""
BEST_ANGLE, WIDTH = 6.0, 12.0
"""Degrees between two views' rays to a point at which they are compared best, and how slowly more becomes worse."""
LEAST_IN_COMMON = 1.0
"""Points that two views must see, each at the best angle, or correspondingly more."""
PLANES = 16, 128
"""Fewest and most planes: otherwise two neighbours are half a pixel apart in the other views."""
WINDOW = 7
"""Side of the windows that are correlated, in pixels."""
MIN_CORRELATION = 0.6
MIN_CONTRAST = 0.015
"""Standard deviation of the brightness, in 0..1, in a window that can be told from its neighbours."""
MOST_POINTS = 10_000
"""Points of the capture by which views are chosen, evenly spread over the list."""
AGREEING = 2
"""Other views that must find the same depth."""
WITHIN = 0.01
"""Largest relative difference of depths that are the same."""
KEPT = 0.25
"""Share of the points that are kept: all of them were no better on held-out views (results/dense-start.json)."""
VIEWS = 100.0
"""Training views with which the share falls to 1/e of that."""
NEGLIGIBLE = 0.05
"""Below it, of `KEPT`, no view is swept."""


class Views(NamedTuple):
    """Pinhole views, padded to one size."""

    rgb: Tensor
    """colours in 0..1, [V, H, W, 3]"""
    valid: Tensor
    """pixels of the photographs, not of the padding, a mask or transparency, bool [V, H, W]"""
    intrinsics: Tensor
    """[V, 3, 3], in pixels"""
    world_to_camera: Tensor
    """x right, y down, z forward, [V, 4, 4]"""


def share_kept(views: int) -> float:
    """Share of the points from photographs that a training with this number of views starts with; 0: none."""
    weight = math.exp(-((views / VIEWS) ** 2))
    return KEPT * weight if weight >= NEGLIGIBLE else 0.0


def small_views(images: Iterable[Tensor], masks: Iterable[Tensor | None], intrinsics: Tensor, poses: Tensor) -> Views:
    """Views at most `SIDE` pixels wide and high.

    Args:
        images: [H, W, 3 or 4], uint8 or in 0..1, on any device.
        masks: bool [H, W, 1]; None: the whole image.
        intrinsics: of the images, [V, 3, 3].
        poses: world to camera, [V, 4, 4].
    """
    device = poses.device
    intrinsics = intrinsics.clone()
    small = []
    for index, (image, mask) in enumerate(zip(images, masks, strict=True)):
        image = image.to(device)
        image = image / 255.0 if image.dtype == torch.uint8 else image.float()
        opaque = image[..., 3:] if image.shape[-1] == 4 else torch.ones_like(image[..., :1])
        if mask is not None:
            opaque = opaque * mask.to(device)
        height, width = image.shape[:2]
        shrink = max(1.0, max(height, width) / SIDE)
        size = max(1, round(height / shrink)), max(1, round(width / shrink))
        planes = torch.cat([image[..., :3], (opaque > 0.99).float()], dim=-1).permute(2, 0, 1)[None]
        small.append(F.interpolate(planes, size=size, mode="area")[0])
        intrinsics[index, 0] *= size[1] / width
        intrinsics[index, 1] *= size[0] / height
    height, width = (max(one.shape[axis] for one in small) for axis in (1, 2))
    table = torch.stack([F.pad(one, (0, width - one.shape[2], 0, height - one.shape[1])) for one in small])
    return Views(table[:, :3].permute(0, 2, 3, 1), table[:, 3] > 0.99, intrinsics, poses)


def neighbours(views: Views, points: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """For each view the depths of the capture's own points [P, 3] in it, occlusion aside, and the views that it is
    compared with [at most SOURCES]: those that see the most of the same points from other places."""
    rotation, shift = views.world_to_camera[:, :3, :3], views.world_to_camera[:, :3, 3]
    seen = points @ rotation.mT + shift[:, None]
    depth = seen[..., 2]
    height, width = views.valid.shape[1:]
    places = (seen @ views.intrinsics.mT)[..., :2] / depth.clamp_min(1e-9)[..., None]
    inside = (depth > 0) & (places > 0).all(-1) & (places[..., 0] < width) & (places[..., 1] < height)
    centers = -(rotation.mT @ shift[..., None])[..., 0]
    rays = F.normalize(points - centers[:, None], dim=-1)
    compared = []
    for one in range(len(centers)):
        angle = torch.rad2deg(torch.acos((rays[one] * rays).sum(-1).clamp(-1, 1)))
        wider = torch.exp(-(((angle - BEST_ANGLE) / WIDTH) ** 2))
        weight = torch.where(angle < BEST_ANGLE, (angle / BEST_ANGLE) ** 2, wider)
        in_common = (weight * (inside[one] & inside)).sum(-1)
        in_common[one] = -1.0
        best = in_common.topk(min(SOURCES, len(in_common)))
        compared.append(best.indices[best.values > (0.05 * best.values[0]).clamp_min(LEAST_IN_COMMON)])
    return [row[within] for row, within in zip(depth, inside, strict=True)], compared


def inverse_depths(views: Views, one: int, others: Tensor, near: float, far: float) -> Tensor:
    """Planes from `far` to `near`, evenly spaced in inverse depth, [D]: half a pixel apart in the others."""
    rays = _rays(views, one)[:: SIDE // 16, :: SIDE // 16].reshape(-1, 3)
    turned, shift = _transfer(views, one, others)
    ends = [rays @ turned.mT + shift[:, None] * (1 / depth) for depth in (near, far)]
    first, last = (end[..., :2] / end[..., 2:].clamp_min(1e-6) for end in ends)
    moved = (first - last).norm(dim=-1)[(ends[0][..., 2] > 1e-6) & (ends[1][..., 2] > 1e-6)]
    count = float(moved.quantile(0.9)) if len(moved) else 0.0
    return torch.linspace(1 / far, 1 / near, int(min(max(2 * count, PLANES[0]), PLANES[1])), device=rays.device)


def sweep(views: Views, grey: Tensor, one: int, others: Tensor, planes: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse depth and correlation of each pixel of a view; correlation -1 where nothing can be said.

    Args:
        grey: brightness in 0..1, [V, 1, H, W].
        others: the views to compare it with, [S].
        planes: inverse depths, evenly spaced, [D].

    Returns:
        [H, W] each.
    """
    own = grey[one][None]
    mean = _window_mean(own)
    variance = (_window_mean(own * own) - mean * mean).clamp_min(0.0)
    turned, shift = _transfer(views, one, others)
    rays = torch.einsum("sij,hwj->shwi", turned, _rays(views, one))
    height, width = own.shape[-2:]
    size = own.new_tensor([width, height])
    decisive = (len(others) + 1) // 2
    pictures = torch.cat([grey[others], views.valid[others, None].to(grey.dtype)], dim=1)
    volume = []
    for plane in planes:
        places = rays + shift[:, None, None] * plane
        ahead = places[..., 2] > 1e-6
        grid = places[..., :2] / places[..., 2:].clamp_min(1e-6) / size * 2 - 1
        warped = F.grid_sample(pictures, grid, padding_mode="zeros", align_corners=False)
        other = warped[:, :1]
        usable = (warped[:, 1] > 0.99) & ahead
        means = _window_mean(torch.cat([other, other * other, other * own], dim=1))
        spread = (means[:, 1:2] - means[:, :1] ** 2).clamp_min(0.0)
        correlation = (means[:, 2:] - means[:, :1] * mean) / (spread * variance + 1e-8).sqrt()
        best_first = torch.where(usable, correlation[:, 0], -1.0).sort(dim=0, descending=True).values
        volume.append(best_first[:decisive].mean(dim=0))
    table = torch.stack(volume)
    best, index = table.max(dim=0)
    inner = index.clamp(1, len(planes) - 2)
    before, here, after = (table.gather(0, (inner + step)[None])[0] for step in (-1, 0, 1))
    curvature = before - 2 * here + after
    peak = torch.where(curvature < -1e-6, 0.5 * (before - after) / curvature, 0.0).clamp(-0.5, 0.5)
    known = (index == inner) & (variance[0, 0].sqrt() > MIN_CONTRAST) & views.valid[one]
    return planes[0] + (inner + peak) * (planes[1] - planes[0]), torch.where(known, best, -1.0)


@torch.no_grad()
def dense_points(
    views: Views, points: Tensor, share: float, track: Callable[[Sequence[int]], Iterable[int]] = iter
) -> tuple[Tensor, Tensor]:
    """Points that several views agree on.

    Args:
        views: of the training.
        points: the capture's own, [P, 3]: which depths are possible, and which views see the same.
        share: of the points found that are returned, drawn at random, always the same.
        track: shows progress over the views.

    Returns:
        Positions [N, 3] and colours in 0..1 [N, 3].
    """
    grey = (views.rgb @ views.rgb.new_tensor([0.299, 0.587, 0.114]))[:, None]
    depths, compared = neighbours(views, points[:: max(len(points) // MOST_POINTS, 1)])
    inverse = grey.new_zeros(len(grey), *grey.shape[2:])
    good = torch.zeros_like(inverse, dtype=torch.bool)
    for one in track(range(len(grey))):
        if len(compared[one]) >= AGREEING and len(depths[one]) > 0:
            near, far = (float(depths[one].quantile(q)) for q in (0.01, 0.99))
            planes = inverse_depths(views, one, compared[one], 0.8 * near, 1.5 * far)
            inverse[one], correlation = sweep(views, grey, one, compared[one], planes)
            good[one] = correlation > MIN_CORRELATION
    maps = [_same(views, inverse, good, one, others) for one, others in enumerate(compared)]
    dense_points.maps = views, inverse, torch.stack(maps)
    found = [_agreed(views, inverse, good, one, others) for one, others in enumerate(compared)]
    xyz, rgb = (torch.cat(tables) for tables in zip(*found, strict=True))
    drawn = torch.rand(len(xyz), generator=torch.Generator().manual_seed(0)).to(xyz.device) < share
    return xyz[drawn], rgb[drawn]


def _agreed(views: Views, inverse: Tensor, good: Tensor, one: int, others: Tensor) -> tuple[Tensor, Tensor]:
    """Points of a view at the same depth in `AGREEING` others; their pixels leave `good`, so that each comes once."""
    chosen = good[one]
    world = torch.linalg.inv(views.world_to_camera[one])
    xyz = _rays(views, one)[chosen] / inverse[one][chosen][:, None] @ world[:3, :3].T + world[:3, 3]
    height, width = good.shape[1:]
    pixels, same = [], []
    for other in others.tolist():
        matrix = views.world_to_camera[other]
        seen = xyz @ matrix[:3, :3].T + matrix[:3, 3]
        x, y = ((seen @ views.intrinsics[other].T)[:, :2] / seen[:, 2:].clamp_min(1e-9)).floor().long().unbind(-1)
        inside = (seen[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        same.append(inside & good[other, y, x] & ((inverse[other, y, x] * seen[:, 2] - 1).abs() < WITHIN))
        pixels.append((other, y, x))
    kept = torch.stack(same).sum(dim=0) >= AGREEING if same else torch.zeros_like(xyz[:, 0], dtype=torch.bool)
    for (other, y, x), agrees in zip(pixels, same, strict=True):
        good[other, y[agrees & kept], x[agrees & kept]] = False
    return xyz[kept], views.rgb[one][chosen][kept]


def _same(views, inverse, good, one, others):
    """Where AGREEING others have the depth that a view has, bool [H, W]."""
    chosen = good[one]
    world = torch.linalg.inv(views.world_to_camera[one])
    xyz = _rays(views, one)[chosen] / inverse[one][chosen][:, None] @ world[:3, :3].T + world[:3, 3]
    height, width = good.shape[1:]
    count = torch.zeros(len(xyz), dtype=torch.int, device=xyz.device)
    for other in others.tolist():
        matrix = views.world_to_camera[other]
        seen = xyz @ matrix[:3, :3].T + matrix[:3, 3]
        x, y = ((seen @ views.intrinsics[other].T)[:, :2] / seen[:, 2:].clamp_min(1e-9)).floor().long().unbind(-1)
        inside = (seen[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        count += inside & good[other, y, x] & ((inverse[other, y, x] * seen[:, 2] - 1).abs() < WITHIN)
    result = torch.zeros_like(chosen)
    result[chosen] = count >= AGREEING
    return result


def _rays(views: Views, one: int) -> Tensor:
    """Rays through the pixels of a view, in its own axes, of depth 1, [H, W, 3]."""
    height, width = views.valid.shape[1:]
    y, x = (torch.arange(side, device=views.rgb.device) + 0.5 for side in (height, width))
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(views.intrinsics[one]).T


def _transfer(views: Views, one: int, others: Tensor) -> tuple[Tensor, Tensor]:
    """A [S, 3, 3] and b [S, 3]: others see the point at ray r and inverse depth w at the pixel of A r + w b."""
    relative = views.world_to_camera[others] @ torch.linalg.inv(views.world_to_camera[one])
    intrinsics = views.intrinsics[others]
    return intrinsics @ relative[:, :3, :3], (intrinsics @ relative[:, :3, 3:])[..., 0]


def _window_mean(images: Tensor) -> Tensor:
    """Means over windows [N, C, H, W] that end at image edges."""
    for size in ((1, WINDOW), (WINDOW, 1)):
        padding = size[0] // 2, size[1] // 2
        images = F.avg_pool2d(images, size, stride=1, padding=padding, count_include_pad=False)
    return images
