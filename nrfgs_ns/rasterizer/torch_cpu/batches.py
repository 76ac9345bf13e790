# SPDX-License-Identifier: Apache-2.0
"""Batches: how the work of compositing is cut up, and the numbers that each piece needs.

Tiles advance together in *slabs* of 32 splats of depth. After each slab the tiles that have run out of splats or of
light leave, so hidden splats cost nothing. A slab is cut into batches of tiles with similar counts, so little is
padded, and the arrays [B, n, 64] of a batch stay within `BATCH_ELEMENTS`, the memory knob of the arithmetic.

Nothing per pixel is stored for the backward pass but T in front of each slab; everything else is computed again.
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
ROWS_AT_ONCE = 2**15  # float64 intermediates of this length stay in cache
N_NUMBERS = 9  # columns of a row of `pair_rows` before the colours
LN_2 = math.log(2.0)
LOG2_NEARLY_MAX_ALPHA = math.log2(0.9989)  # a splat below this opacity stays below 0.999 however l is rounded
NOTHING = -1e5  # exp2(NOTHING) = 0: the log-alpha of padding


class Sheet:
    """The constant part of the work: splats in depth order, the tile grid and its pixel basis."""

    def __init__(self, prints: Footprints, colors: Tensor, n_cameras: int, width: int, height: int) -> None:
        self.prints = prints
        self.colors = colors  # [F, D]
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


def pair_rows(sheet: Sheet, lists: TileLists) -> Tensor:
    """What compositing needs of each (tile, splat) pair, in one row: sigma expanded around the tile's centre.

    Columns: the coefficients of l in (1, x, y, x^2, xy, y^2), divided by ln 2 because exp2 is three times faster than
    exp; mx, my; log2 o; colours. [K, 9 + D]
    """
    edge, tiles_x = sheet.prints.edge, sheet.prints.tiles_x
    rows = sheet.colors.new_empty(lists.splat.numel(), N_NUMBERS + sheet.colors.shape[1])
    centres = torch.stack([lists.tiles % tiles_x, lists.tiles // tiles_x]).double().add_(0.5).mul_(edge)
    tile_x, tile_y = (t.repeat_interleave(lists.count, output_size=len(rows)) for t in centres)
    pieces = (t.split(ROWS_AT_ONCE) for t in (rows, lists.splat, tile_x, tile_y))
    for piece, splat, tile_x, tile_y in zip(*pieces, strict=True):
        x, y, a, b, c, log_opacity = (row.index_select(0, splat) for row in sheet.prints.shape)
        mx, my = x - tile_x, y - tile_y
        a, b, c, log_opacity = (t / LN_2 for t in (a, b, c, log_opacity))
        gx, gy = a * mx + b * my, b * mx + c * my
        peak = log_opacity - 0.5 * (mx * gx + my * gy)
        for column, values in enumerate((peak, gx, gy, -0.5 * a, -b, -0.5 * c, mx, my, log_opacity)):
            piece[:, column] = values
        piece[:, N_NUMBERS:] = sheet.colors.index_select(0, splat)
    return rows


@dataclass
class Batch:
    """Tiles that are composited together over one slab: B tiles, n splats each, P pixels per tile."""

    tiles: Tensor  # positions in TileLists.tiles. [B]
    first: int  # depth of the slab's first splat
    n: int
    transmittance: Tensor  # T where the slab begins; 0 in finished pixels. [B, P]

    def pairs(self, lists: TileLists) -> tuple[Tensor, Tensor]:
        """The pairs [B, n] of its tiles, and which of them are listed: the others pad shorter lists."""
        depth = torch.arange(self.first, self.first + self.n)
        pairs = lists.start.index_select(0, self.tiles)[:, None] + depth
        listed = depth < lists.count.index_select(0, self.tiles)[:, None]
        return pairs.clamp_(max=lists.splat.numel() - 1), listed


class Numbers(NamedTuple):
    """The rows of a batch. [B, n, ...]"""

    coefficients: Tensor  # [B, n, 6]
    centres: Tensor  # mx, my. [B, n, 2]
    colors: Tensor  # [B, n, D]
    strong: Tensor  # which of the B * n can exceed 0.999


def gather(rows: Tensor, pairs: Tensor, listed: Tensor) -> Numbers:
    """Gather the rows of a batch; padding gets an opacity of 0."""
    rows = rows.index_select(0, pairs.flatten()).view(*pairs.shape, -1)
    rows[..., 0].masked_fill_(~listed, NOTHING)
    strong = (rows[..., 8] > LOG2_NEARLY_MAX_ALPHA).flatten().nonzero().squeeze(1)
    return Numbers(rows[..., :6], rows[..., 6:8], rows[..., N_NUMBERS:], strong)


def similar_tiles(remaining: Tensor, tiles: Tensor, pixels: int) -> list[Tensor]:
    """Cut tiles, sorted by falling number of splats, into groups of similar numbers within BATCH_ELEMENTS."""
    counts = remaining.tolist()
    groups, begin = [], 0
    while begin < len(counts):
        end = min(len(counts), begin + max(1, BATCH_ELEMENTS // ((counts[begin] + 1) * pixels)))
        enough = 0.75 * counts[begin] - 4  # bounds the padding to a quarter, or four splats
        while counts[end - 1] < enough:
            end -= 1
        groups.append(tiles[begin:end])
        begin = end
    return groups
