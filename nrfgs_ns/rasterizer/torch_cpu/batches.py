# SPDX-License-Identifier: Apache-2.0
"""Batches of tiles and their splats: what `compositing.py` blends at once.

Tiles advance together in *slabs* of 16 splats of depth. After each slab the tiles that have run out of splats
or of light leave, so hidden splats cost nothing. A slab is cut into batches of tiles with similar counts, so little is
padded, and the arrays [B, n, 64] of a batch stay within `BATCH_ELEMENTS` for each thread, which bounds the memory. For
the backward pass a batch keeps T in front of its slab and its splats' coefficients; all that is per pixel and splat is
computed again.

Slabs are shallow so that batches are wide: torch divides only operations on more than 32,768 numbers among its threads,
and in a wide batch even the slice [B, 64] of a single splat is divided, at the same tile as the whole, so that each
core reads what it has written itself.

The log-alpha of splat k at a pixel, l_k = ln o_k - sigma_k, is written around the centre of the pixel's tile, with x
the offset from it and m_k = (mx, my) the splat's:

    l_k(x) = [ln o - s] + gx x + gy y - a x^2 / 2 - b xy - c y^2 / 2,    (gx, gy) = Q_k m_k,    s = m_k . (gx, gy) / 2,

which is linear in (1, x, y, x^2 / 2, xy, y^2 / 2). Those six are the same for every tile, so the l of all splats at
all 64 pixels is one matrix product. The six coefficients are formed in float64: they are where a needle far from its
tile cancels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from .tiles import MIN_ALPHA, SUB_TILE, Footprints, TileLists

MAX_ALPHA = 0.999  # alpha is capped here
SLAB = 16  # splats of depth between two checks for finished tiles
BATCH_ELEMENTS = 2**19  # pixels x splats in flight per thread; four float arrays of this size exist at a time (8 MiB)
MAX_THREADS = 16  # threads beyond which batches do not grow
LN_2 = math.log(2.0)
LOG2_NEARLY_MAX_ALPHA = math.log2(0.9989)  # a splat below this opacity stays below 0.999 however l is rounded
NOTHING = -1e5  # exp2(NOTHING) = 0: the log-alpha of padding


def batch_elements() -> int:
    """Pixels x splats of a batch."""
    return BATCH_ELEMENTS * min(torch.get_num_threads(), MAX_THREADS)


class Canvas:
    """What all batches share: the F splats in depth order, the tile grid, a tile's pixel basis and scratch memory.

    A row of `geometry` or `conics_colors` has all numbers of a splat, so that each pair fetches it once. Row F is an
    invisible splat, which pads lists that are too short.
    """

    def __init__(self, footprints: Footprints, colors: Tensor, n_cameras: int, width: int, height: int) -> None:
        self.footprints = footprints
        edge, dtype = SUB_TILE, colors.dtype
        # Conic and ln(o) divided by ln 2, because exp2 is three times faster than exp.
        columns = torch.cat([footprints.geometry[:2], footprints.geometry[2:] / LN_2])  # [6, F], float64
        padding = columns.new_tensor([[0.0, 0.0, 0.0, 0.0, 0.0, NOTHING]])
        self.geometry = torch.cat([columns.t(), padding])  # centre x, y, conic a, b, c, ln(o). [F + 1, 6], float64
        minus_conics = -columns[2:5].t().to(dtype)
        self.conics_colors = F.pad(torch.cat([minus_conics, colors], 1), (0, 0, 0, 1))  # [F + 1, 3 + D]

        self.n_tiles = n_cameras * footprints.tiles_y * footprints.tiles_x
        offsets = torch.arange(edge, dtype=dtype) - (edge - 1) / 2
        y, x = (grid.flatten() for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
        self.basis = torch.stack([torch.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])  # [6, P]

        # 1 inside the images, 0 in the part of a tile beyond their edge. [C * tiles, P]
        self.inside = self.tiled(torch.ones(n_cameras, height, width, 1, dtype=dtype)).squeeze(1)
        self.scratch = Scratch(max(batch_elements(), (SLAB + 1) * edge * edge), dtype)
        # The largest number below MIN_ALPHA: threshold_ keeps what is strictly greater.
        self.too_faint = torch.tensor(MIN_ALPHA, dtype=dtype).nextafter(torch.zeros((), dtype=dtype)).item()

    def centres(self, tiles: Tensor) -> Tensor:
        """Centres x, y of tiles in pixels, y counted from the top of the first image. [L] -> [2, L, 1], float64"""
        tiles_x = self.footprints.tiles_x
        return (torch.stack([tiles % tiles_x, tiles // tiles_x])[..., None].double() + 0.5) * SUB_TILE

    def image(self, values: Tensor, n_cameras: int, width: int, height: int) -> Tensor:
        """Put tiles back into images. [C * tiles, D, P] -> [C, H, W, D]"""
        edge, tiles_x, tiles_y = SUB_TILE, self.footprints.tiles_x, self.footprints.tiles_y
        values = values.view(n_cameras, tiles_y, tiles_x, -1, edge, edge).permute(0, 1, 4, 2, 5, 3)
        return values.reshape(n_cameras, tiles_y * edge, tiles_x * edge, -1)[:, :height, :width].contiguous()

    def tiled(self, images: Tensor) -> Tensor:
        """Inverse of `image`, 0 outside the images. [C, H, W, D] -> [C * tiles, D, P]"""
        edge, tiles_x, tiles_y = SUB_TILE, self.footprints.tiles_x, self.footprints.tiles_y
        n_cameras, height, width, channels = images.shape
        images = F.pad(images, (0, 0, 0, tiles_x * edge - width, 0, tiles_y * edge - height))
        images = images.view(n_cameras, tiles_y, edge, tiles_x, edge, channels).permute(0, 1, 3, 5, 2, 4)
        return images.reshape(self.n_tiles, channels, edge * edge)


class Scratch:
    """Memory for the arrays of a batch, `size` numbers each, used by one batch after the other.

    To get megabytes from the system takes longer than a pass of arithmetic over them. Slices are kept, too: making them
    takes a fifth of their arithmetic's time.
    """

    def __init__(self, size: int, dtype: torch.dtype) -> None:
        self.size, self.dtype = size, dtype
        self._memory: dict[str, Tensor] = {}
        self._arrays: dict[tuple, tuple[Tensor, tuple[Tensor, ...]]] = {}

    def array(self, name: str, n_tiles: int, n: int, pixels: int) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The memory of a name as [B, n, P] and its n slices [B, P], not cleared."""
        key = name, n_tiles, n, pixels
        if key not in self._arrays:
            if name not in self._memory:
                self._memory[name] = torch.empty(self.size, dtype=self.dtype)
            array = self._memory[name][: n_tiles * n * pixels].view(n_tiles, n, pixels)
            self._arrays[key] = array, array.unbind(1)
        return self._arrays[key]


class LocalSplats(NamedTuple):
    """The R = B n splats of a batch in tile coordinates: l is expanded around the centres of their tiles."""

    coefficients: Tensor  # of l / ln 2 in (1, x, y, x^2 / 2, xy, y^2 / 2): ln o - s, gx, gy, -a, -b, -c. [6, R]
    centres: Tensor  # mx, my. [2, R]
    colors: Tensor  # [B, n, D]
    strong: Tensor  # indices in 0..R-1 of those that can exceed an alpha of 0.999


@dataclass
class Batch:
    """Tiles that are composited together over one slab: B tiles, n splats each, P pixels per tile."""

    tiles: Tensor  # positions in TileLists.tiles. [B]
    pairs: Tensor  # (tile, splat) pairs, as positions in TileLists.splat; K for padding. [B, n]
    splats: LocalSplats
    transmittance: Tensor  # T where the slab begins; 0 in finished pixels. [B, P]


def pairs_of(lists: TileLists, tiles: Tensor, first: int, n: int) -> Tensor:
    """The n pairs of each of B tiles from the `first` in depth on, [B, n]; K, the padding, where a list is shorter."""
    depth = torch.arange(first, first + n)
    start, count = lists.start.index_select(0, tiles), lists.count.index_select(0, tiles)
    return torch.where(depth < count[:, None], start[:, None] + depth, lists.n_pairs)


def expand_around_centres(canvas: Canvas, lists: TileLists, centres: Tensor, pairs: Tensor) -> LocalSplats:
    """Fetch the splats of a batch and expand l around the centres of its tiles, as in the module's docstring.

    Args:
        centres: x and y of the tiles' centres in pixels, as columns. [2, B, 1], float64
        pairs: [B, n]
    """
    splat = lists.splat.index_select(0, pairs.flatten())
    x, y, a, b, c, log_opacity = canvas.geometry.index_select(0, splat).view(*pairs.shape, 6).unbind(-1)
    conics_colors = canvas.conics_colors.index_select(0, splat)

    mx, my = x - centres[0], y - centres[1]
    gx, gy = torch.addcmul(b * my, a, mx), torch.addcmul(b * mx, c, my)
    constant = torch.add(log_opacity, torch.addcmul(mx * gx, my, gy), alpha=-0.5)  # ln o - s
    rows = conics_colors.new_empty(8, *pairs.shape)  # the coefficients, then the splat's centre
    for row, values in zip((0, 1, 2, 6, 7), (constant, gx, gy, mx, my), strict=True):
        rows[row] = values
    rows = rows.flatten(1)
    rows[3:6] = conics_colors[:, :3].t()
    strong = (log_opacity > LOG2_NEARLY_MAX_ALPHA).flatten().nonzero().squeeze(1)
    return LocalSplats(rows[:6], rows[6:], conics_colors[:, 3:].view(*pairs.shape, -1), strong)


def group_by_count(remaining: Tensor, tiles: Tensor, pixels: int) -> list[tuple[Tensor, int]]:
    """Cut tiles [L] with `remaining` splats in this slab, [L] and descending, into groups of similar counts that fit
    into a batch: pairs of a group's tiles and their largest count."""
    counts = remaining.tolist()
    groups = []
    begin = 0
    elements = batch_elements()
    while begin < len(counts):
        end = min(len(counts), begin + max(1, elements // ((counts[begin] + 1) * pixels)))
        fewest = 0.75 * counts[begin] - 4  # bounds the padding to a quarter, or four splats
        while counts[end - 1] < fewest:
            end -= 1
        groups.append((tiles[begin:end], counts[begin]))
        begin = end
    return groups
