# SPDX-License-Identifier: Apache-2.0
"""Tiles: the splats that can touch each tile of pixels, front to back.

gsplat lets a splat touch exactly the `tile_size` tiles that its radius square meets. That rule is part of its image (it
truncates tails at tile borders), so it is kept. Inside these tiles the splats are listed per *sub-tile* of 8 x 8
pixels, and only where they can matter: alpha = o exp(-sigma) >= 1/255 holds inside the ellipse

    sigma(d) = (a dx^2 + 2 b dx dy + c dy^2) / 2 <= s,        s = ln(255 o),

and nowhere else. On the horizontal line dy the ellipse spans

    dx = -(b / a) dy -+ sqrt(2 s / a - (a c - b^2) / a^2 dy^2),

and its extreme points lie at dx = -+ sqrt(2 s c / (a c - b^2)), dy = +- (b / c) times that. Within a row of sub-tiles
the leftmost point is therefore the one on the line nearest to the leftmost extreme, and likewise on the right: each
(splat, row) yields one exact interval of columns, so a long needle is listed along its length and not over its box.

Splats are put in depth order once (stable, so equal depths keep their index order, as in gsplat), expanded into pairs
in that order, and the pairs are stably sorted by tile. Both sorts are radix sorts on integers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from .. import TILE_SIZE, Projection

SUB_TILE = 8  # pixels, a divisor of TILE_SIZE; smaller wastes work on lists, larger on pixels out of a splat's reach
MIN_ALPHA = 1.0 / 255.0
FLATTEST = 1e-30  # conic entries of a splat so large that they underflow; keeps its ellipse finite
REACH_SLACK = 1e-3  # added to s: covers the rounding of sigma in float32 (below 1e-4), so that no pair is lost


class Block(NamedTuple):
    """A rectangle of sub-tiles. All cameras' rows are stacked: row = camera * tiles_y + y."""

    row0: int
    row1: int
    col0: int
    col1: int


@dataclass
class Footprints:
    """The F of M projected splats that can be seen, in depth order, and the sub-tiles around them."""

    tiles_x: int  # sub-tiles per row of an image
    tiles_y: int  # sub-tiles per column of an image
    rows: Tensor  # their rows in the projection. [F], int64
    geometry: Tensor  # centre x, y (from the top of the stacked images), conic a, b, c, ln(opacity). [6, F], float64
    spans: Tensor  # first and end row, first and end column in sub-tiles of the stacked images. [4, F], int64

    @property
    def whole(self) -> Block:
        """All rows that any splat meets, all columns."""
        if self.rows.numel() == 0:
            return Block(0, 0, 0, 0)
        return Block(int(self.spans[0].min()), int(self.spans[1].max()), 0, self.tiles_x)


@dataclass
class TileLists:
    """The K (sub-tile, splat) pairs of a block."""

    tiles: Tensor  # sub-tiles that have splats, as indices into all C * tiles_y * tiles_x. [L], int64
    start: Tensor  # first pair of each sub-tile. [L], int64
    count: Tensor  # number of its pairs. [L], int64
    splat: Tensor  # footprint of each pair, sorted by sub-tile, then depth; F for pair K, the padding. [K + 1], int64
    slot: Tensor  # place of each pair when sorted by splat, where its gradient is collected; then K. [K + 1], int64
    splat_start: Tensor  # first slot of each footprint. [F], int64

    @property
    def n_pairs(self) -> int:
        return self.splat.numel() - 1


def _inclusive_range(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Sub-tiles [first, end) with a pixel centre in [low, high] (pixels, float64). Centres lie at +0.5."""
    return torch.ceil((low - (SUB_TILE - 0.5)) / SUB_TILE), torch.floor((high - 0.5) / SUB_TILE) + 1


def _square_range(centre: Tensor, radius: Tensor, n_tiles: int) -> tuple[Tensor, Tensor]:
    """Gsplat's rule: tiles [floor((m - r) / size), ceil((m + r) / size)), in the precision of the input."""
    centre, radius = centre / TILE_SIZE, radius / TILE_SIZE
    return (centre - radius).floor().clamp(0, n_tiles), (centre + radius).ceil().clamp(0, n_tiles)


def _ellipse(a: Tensor, b: Tensor, c: Tensor, log_opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Determinant a c - b^2 of each conic, and 2 s of the module's docstring. [F] each"""
    return a * c - b * b, 2 * (log_opacity - math.log(MIN_ALPHA) + REACH_SLACK)


def find_footprints(projection: Projection, opacities: Tensor) -> Footprints:
    """Bound every splat, with opacities [M], by gsplat's tiles and by its own 1/255 ellipse; drop invisible ones."""
    per_tile = TILE_SIZE // SUB_TILE
    width, height = projection.width, projection.height
    tiles_x, tiles_y = -(-width // SUB_TILE), -(-height // SUB_TILE)

    # The bits of a positive float sort like the float; the integer sort is an order of magnitude faster.
    bits = projection.depths.view(torch.int32 if projection.depths.dtype == torch.float32 else torch.int64)
    order = torch.sort(bits, stable=True).indices
    order = order[opacities.index_select(0, order) >= MIN_ALPHA]

    means2d = projection.means2d.index_select(0, order)
    radii = projection.radii.index_select(0, order).to(means2d.dtype)
    x, y = means2d.t()
    x0, x1 = _square_range(x, radii, -(-width // TILE_SIZE))
    y0, y1 = _square_range(y, radii, -(-height // TILE_SIZE))

    a, b, c = projection.conics.index_select(0, order).double().t()
    a, c = a.clamp(min=FLATTEST), c.clamp(min=FLATTEST)
    # Rounding can make the stored conic of an extreme needle indefinite; an ulp off b makes it definite again.
    limit = (a * c).sqrt() * (1 - 2.0**-22)
    b = torch.maximum(torch.minimum(b, limit), -limit)
    log_opacity = opacities.index_select(0, order).double().log()
    geometry = torch.stack([x.double(), y.double(), a, b, c, log_opacity])

    det, two_s = _ellipse(a, b, c, log_opacity)
    half_x, half_y = (two_s * c / det).sqrt(), (two_s * a / det).sqrt()
    col0, col1 = _inclusive_range(geometry[0] - half_x, geometry[0] + half_x)
    row0, row1 = _inclusive_range(geometry[1] - half_y, geometry[1] + half_y)
    col0, col1 = col0.maximum(x0 * per_tile), col1.minimum((x1 * per_tile).clamp(max=tiles_x))
    row0, row1 = row0.maximum(y0 * per_tile), row1.minimum((y1 * per_tile).clamp(max=tiles_y))

    kept = ((col0 < col1) & (row0 < row1)).nonzero().squeeze(1)
    spans = torch.stack([row0, row1, col0, col1]).index_select(1, kept).long()
    order, geometry = order.index_select(0, kept), geometry.index_select(1, kept)
    images_above = projection.camera_ids.index_select(0, order)
    spans[:2] += images_above * tiles_y
    geometry[1] += images_above * (tiles_y * SUB_TILE)
    return Footprints(tiles_x, tiles_y, order, geometry, spans)


def _clip(spans: Tensor, block: Block) -> Tensor:
    """Spans within a block, with an empty range of rows for splats outside. [4, F]"""
    row0, row1 = spans[0].clamp(min=block.row0), spans[1].clamp(max=block.row1)
    col0, col1 = spans[2].clamp(min=block.col0), spans[3].clamp(max=block.col1)
    row1 = torch.where(col0 < col1, row1.maximum(row0), row0)
    return torch.stack([row0, row1, col0, col1])


def split_into_blocks(footprints: Footprints, max_pairs: int) -> list[Block]:
    """Blocks of at most `max_pairs` pairs (by bounding boxes), or of one sub-tile, that cover all splats."""

    def split(block: Block) -> list[Block]:
        row0, row1, col0, col1 = block
        clipped = _clip(footprints.spans, block)
        pairs = ((clipped[1] - clipped[0]) * (clipped[3] - clipped[2])).sum()
        if pairs <= max_pairs or (row1 - row0 == 1 and col1 - col0 == 1):
            return [block] if pairs > 0 else []
        if row1 - row0 > 1:
            middle = (row0 + row1) // 2
            return split(block._replace(row1=middle)) + split(block._replace(row0=middle))
        middle = (col0 + col1) // 2
        return split(block._replace(col1=middle)) + split(block._replace(col0=middle))

    return split(footprints.whole)


def list_tiles(footprints: Footprints, block: Block) -> TileLists:
    """List the splats of each sub-tile of a block, front to back: each splat is expanded into rows, each row into
    columns."""
    row0, row1, col0, col1 = _clip(footprints.spans, block)

    # (splat, row) pairs, splat by splat.
    n_rows = row1 - row0
    row_end = n_rows.cumsum(0)
    total = int(row_end[-1])
    splat = torch.repeat_interleave(n_rows, output_size=total)
    row = torch.arange(total) + (row0 - row_end + n_rows).index_select(0, splat)

    # The columns that the ellipse covers on the pixel rows [y0, y1]: on the line dy, dx = slope dy -+ sqrt(widest -
    # narrowing dy^2).
    x, y, a, b, c, log_opacity = footprints.geometry
    det, two_s = _ellipse(a, b, c, log_opacity)
    rightmost = -(b / c) * (two_s * c / det).sqrt()
    ellipse = torch.stack([x, y, rightmost, -b / a, two_s / a, det / (a * a)])
    x, y, rightmost, slope, widest, narrowing = (column.index_select(0, splat) for column in ellipse)
    y0 = (row * SUB_TILE + 0.5) - y
    y1 = y0 + (SUB_TILE - 1)
    ends = []
    for side in (-1, 1):
        dy = (side * rightmost).clamp(y0, y1)
        half = torch.addcmul(widest, narrowing, dy * dy, value=-1).clamp_(min=0).sqrt_()
        ends.append(torch.addcmul(x, slope, dy).add_(half, alpha=side))
    first, end = _inclusive_range(*ends)
    first = first.maximum(col0.index_select(0, splat)).long()
    n_cols = (end.minimum(col1.index_select(0, splat)).long() - first).clamp(min=0)

    # (splat, row, column) pairs.
    col_end = n_cols.cumsum(0)
    total = int(col_end[-1])
    entry = torch.repeat_interleave(n_cols, output_size=total)
    tile = torch.arange(total) + (row * footprints.tiles_x + first - col_end + n_cols).index_select(0, entry)
    splat_start = torch.cat([col_end.new_zeros(1), col_end]).index_select(0, row_end - n_rows)

    tile, slot = torch.sort(tile.to(torch.int32), stable=True)
    tiles, count = torch.unique_consecutive(tile, return_counts=True)
    splat = splat.index_select(0, entry).index_select(0, slot)
    splat, slot = F.pad(splat, (0, 1), value=footprints.rows.numel()), F.pad(slot, (0, 1), value=slot.numel())
    return TileLists(tiles.long(), count.cumsum(0) - count, count, splat, slot, splat_start)
