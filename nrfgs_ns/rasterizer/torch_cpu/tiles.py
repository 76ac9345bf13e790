# SPDX-License-Identifier: Apache-2.0
"""Tiles: the splats that can touch each tile of pixels, front to back, and batches of tiles, blended at once.

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

`compositing.py` blends them in batches, where a tile is a sub-tile. Tiles advance together in *slabs* of 16 splats of
depth. After each slab the tiles that have run out of splats or of light leave, so hidden splats cost nothing. A slab is
cut into batches of tiles with similar counts, so little is padded, and the arrays [B, n, 64] of a batch stay within
`BATCH_ELEMENTS` for each thread, which bounds the memory. For the backward pass a batch keeps T in front of its slab
and its splats' coefficients; all that is per pixel and splat is computed again.

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

from .. import TILE_SIZE, Projection

SUB_TILE = 8  # pixels, a divisor of TILE_SIZE; smaller wastes work on lists, larger on pixels out of a splat's reach
MIN_ALPHA = 1.0 / 255.0
FLATTEST = 1e-30  # conic entries of a splat so large that they underflow; keeps its ellipse finite
REACH_SLACK = 1e-3  # added to s: covers the rounding of sigma in float32 (below 1e-4), so that no pair is lost
MAX_ALPHA = 0.999  # alpha is capped here
SLAB = 16  # splats of depth between two checks for finished tiles
BATCH_ELEMENTS = 2**19  # pixels x splats in flight per thread; four float arrays of this size exist at a time (8 MiB)
MAX_THREADS = 16  # threads beyond which batches do not grow
LN_2 = math.log(2.0)
LOG2_NEARLY_MAX_ALPHA = math.log2(0.9989)  # a splat below this opacity stays below 0.999 however l is rounded
NOTHING = -1e5  # exp2(NOTHING) = 0: the log-alpha of padding


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
    """List the splats of each sub-tile of a block, front to back: splats are expanded into rows, rows into columns."""
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
        columns_rows = torch.stack([tiles % tiles_x, tiles // tiles_x])[..., None]
        return (columns_rows.double() + 0.5) * SUB_TILE

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
