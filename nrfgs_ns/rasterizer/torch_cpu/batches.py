# SPDX-License-Identifier: Apache-2.0
"""Batches: how the work of compositing is cut up, and the numbers that each piece needs.

Tiles advance together in *slabs* of 32 splats of depth. After each slab the tiles that have run out of splats or of
light leave, so hidden splats cost nothing. A slab is cut into batches of tiles with similar counts, so little is
padded, and the arrays [B, n, 64] of a batch stay within `BATCH_ELEMENTS`, the memory knob of the arithmetic.

For the backward pass a batch keeps T in front of its slab and the numbers of its splats; all that is per pixel and
splat is computed again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from .tiles import Footprints, TileLists

SLAB = 32  # splats of depth between two looks at which tiles are finished
BATCH_ELEMENTS = 2**19  # pixels x splats in flight; four float arrays of this size exist at a time (8 MiB)
LN_2 = math.log(2.0)
LOG2_NEARLY_MAX_ALPHA = math.log2(0.9989)  # a splat below this opacity stays below 0.999 however l is rounded
NOTHING = -1e5  # exp2(NOTHING) = 0: the log-alpha of padding


class Sheet:
    """The constant part of the work: splats in depth order, the tile grid and its pixel basis."""

    def __init__(self, prints: Footprints, colors: Tensor, n_cameras: int, width: int, height: int) -> None:
        self.prints = prints
        self.colors = colors  # [F, D]
        # Conic and ln(o) divided by ln 2, because exp2 is three times faster than exp.
        self.shape = torch.cat([prints.shape[:2], prints.shape[2:] / LN_2])  # [6, F], float64
        self.n_tiles = n_cameras * prints.tiles_y * prints.tiles_x
        edge, dtype = prints.edge, colors.dtype
        offsets = torch.arange(edge, dtype=dtype) - (edge - 1) / 2
        y, x = (grid.flatten() for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
        self.basis = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])  # [6, P]

        inside_x = (torch.arange(prints.tiles_x * edge) < width).view(1, 1, prints.tiles_x, 1, edge)
        inside_y = (torch.arange(prints.tiles_y * edge) < height).view(1, prints.tiles_y, 1, edge, 1)
        inside = (inside_x & inside_y).expand(n_cameras, -1, -1, -1, -1)
        self.inside = inside.reshape(self.n_tiles, edge * edge).to(dtype)  # 1 in pixels of the image. [C * tiles, P]

        self._memory: dict[str, Tensor] = {}
        self._buffers: dict[tuple, tuple[Tensor, tuple[Tensor, ...]]] = {}

    def buffer(self, name: str, n_tiles: int, n: int, pixels: int) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Scratch memory as [B, n, P] and its n slices [B, P].

        It is reused: the allocator returns arrays of megabytes to the system, and getting them back costs more than a
        pass of arithmetic; making n slices costs as much as a fifth of their arithmetic.
        """
        key = name, n_tiles, n, pixels
        if key not in self._buffers:
            size = n_tiles * n * pixels
            if name not in self._memory:
                self._memory[name] = self.basis.new_empty(max(BATCH_ELEMENTS, (SLAB + 1) * pixels))
            tensor = self._memory[name][:size].view(n_tiles, n, pixels)
            self._buffers[key] = tensor, tensor.unbind(1)
        return self._buffers[key]

    def centres(self, tiles: Tensor) -> Tensor:
        """Centres x, y of tiles in pixels, y counted from the top of the first image. [L] -> [2, L, 1], float64"""
        tiles_x = self.prints.tiles_x
        corners = torch.stack([tiles % tiles_x, tiles // tiles_x])[..., None]
        return (corners.double() + 0.5) * self.prints.edge

    def image(self, values: Tensor, n_cameras: int, width: int, height: int) -> Tensor:
        """Put tiles back into images. [C * tiles, D, P] -> [C, H, W, D]"""
        edge, tiles_x, tiles_y = self.prints.edge, self.prints.tiles_x, self.prints.tiles_y
        values = values.view(n_cameras, tiles_y, tiles_x, -1, edge, edge).permute(0, 1, 4, 2, 5, 3)
        return values.reshape(n_cameras, tiles_y * edge, tiles_x * edge, -1)[:, :height, :width].contiguous()

    def tiled(self, images: Tensor) -> Tensor:
        """Inverse of `image`, 0 outside the images. [C, H, W, D] -> [C * tiles, D, P]"""
        edge, tiles_x, tiles_y = self.prints.edge, self.prints.tiles_x, self.prints.tiles_y
        n_cameras, height, width, channels = images.shape
        images = F.pad(images, (0, 0, 0, tiles_x * edge - width, 0, tiles_y * edge - height))
        images = images.view(n_cameras, tiles_y, edge, tiles_x, edge, channels).permute(0, 1, 3, 5, 2, 4)
        return images.reshape(self.n_tiles, channels, edge * edge)


class Numbers(NamedTuple):
    """What compositing needs of the R = B n splats of a batch: sigma expanded around the centres of their tiles."""

    coefficients: Tensor  # of l / ln 2 in (1, x, y, x^2, xy, y^2). [6, R]
    centres: Tensor  # mx, my. [2, R]
    colors: Tensor  # [B, n, D]
    strong: Tensor  # which of the R can exceed an alpha of 0.999


@dataclass
class Batch:
    """Tiles that are composited together over one slab: B tiles, n splats each, P pixels per tile."""

    tiles: Tensor  # positions in TileLists.tiles. [B]
    pairs: Tensor  # of its tiles and splats; padding has the number of all pairs. [B, n]
    numbers: Numbers
    transmittance: Tensor  # T where the slab begins; 0 in finished pixels. [B, P]


def pairs_of(lists: TileLists, tiles: Tensor, first: int, n: int) -> Tensor:
    """The pairs [B, n] of some tiles from depth `first` on; K, one more than the last, where a list is shorter."""
    depth = torch.arange(first, first + n)
    pairs = lists.start.index_select(0, tiles)[:, None] + depth
    listed = depth < lists.count.index_select(0, tiles)[:, None]
    return pairs.masked_fill_(~listed, lists.splat.numel())


def expand(sheet: Sheet, lists: TileLists, centres: Tensor, pairs: Tensor) -> Numbers:
    """Gather the splats of a batch and expand sigma around the centres of its tiles; padding gets an opacity of 0.

    Args:
        centres: x and y of the tiles' centres in pixels, as columns. [2, B, 1], float64
        pairs: [B, n]
    """
    n_pairs = lists.splat.numel()
    splat = lists.splat.index_select(0, pairs.clamp(max=n_pairs - 1).flatten())
    x, y, a, b, c, log_opacity = (row.index_select(0, splat).view_as(pairs) for row in sheet.shape)
    mx, my = x - centres[0], y - centres[1]
    gx, gy = a * mx + b * my, b * mx + c * my
    peak = (log_opacity - 0.5 * (mx * gx + my * gy)).masked_fill_(pairs == n_pairs, NOTHING)
    dtype = sheet.colors.dtype
    coefficients = sheet.colors.new_empty(6, *pairs.shape)
    for row, values in zip(coefficients, (peak, gx, gy, -0.5 * a, -b, -0.5 * c), strict=True):
        row.copy_(values)
    strong = (log_opacity > LOG2_NEARLY_MAX_ALPHA).flatten().nonzero().squeeze(1)
    colors = sheet.colors.index_select(0, splat).view(*pairs.shape, -1)
    return Numbers(coefficients.flatten(1), torch.stack([mx, my]).to(dtype).flatten(1), colors, strong)


def similar_tiles(remaining: Tensor, tiles: Tensor, pixels: int) -> list[tuple[Tensor, int]]:
    """Cut tiles, sorted by falling number of splats, into groups of similar numbers within BATCH_ELEMENTS.

    Returns:
        For each group its tiles and the largest of their numbers.
    """
    counts = remaining.tolist()
    groups, begin = [], 0
    while begin < len(counts):
        end = min(len(counts), begin + max(1, BATCH_ELEMENTS // ((counts[begin] + 1) * pixels)))
        enough = 0.75 * counts[begin] - 4  # bounds the padding to a quarter, or four splats
        while counts[end - 1] < enough:
            end -= 1
        groups.append((tiles[begin:end], counts[begin]))
        begin = end
    return groups
