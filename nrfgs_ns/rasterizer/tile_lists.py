# SPDX-License-Identifier: Apache-2.0
"""Lists of the splats that each tile draws, front to back: gsplat's lists without what draws nothing.

gsplat lists a splat in every tile of the square of three standard deviations around it; its kernels skip pixels where

    opacity exp(-sigma) < 1 / 255        sigma = 1/2 (a dx^2 + c dy^2) + b dx dy,  (a, b, c) the conic.

Here a splat is listed in those tiles of its square that have a pixel's centre in that ellipse (Feng et al., FlashGS,
and Hanson et al., Speedy-Splat, 2024). Images and gradients are gsplat's, also with tiles of half its side, since the
square is made of its tiles. All pixels of a tile go through the tile's list, which is shorter then.

An ellipse meets a row of tiles in one interval of columns, which ends at the ellipse's own leftmost and rightmost
points, or, where these lie outside the row's band, on the band's nearer edge.

Splats are sorted by depth, then listed in that order; a stable sort by tile does the rest, to gsplat's last tie. 16-bit
tile numbers take a quarter of the passes of its 64-bit keys. Tiles of half the side have twice the pairs: instead, four
bits of a pair can say in which quarters of its tile it draws, and the tile's list is split behind the sort.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import triton
import triton.language as tl
from torch import Tensor

from . import TILE_SIZE

SPLATS = 64
"""Splats whose tiles one program counts; a power of two."""
PAIRS = 256
"""Pairs of a splat and a tile that one program lists; a power of two."""
BATCH = 256
"""Pairs that one program splits at a time; a power of two, at most 2^15."""
TILE = tl.constexpr(TILE_SIZE)
"""Side of gsplat's tiles in pixels."""
FIRST = tl.constexpr(-(2**15))
"""The first tile's number."""

SLACK = tl.constexpr(0.02)
"""Added to the bound of sigma, for the rounding of the drawing kernels."""
MARGIN = tl.constexpr(1e-3)
"""Share, and pixels, by which the ellipse's half axes are lengthened, for the rounding here."""


@triton.jit
def _ellipse(means2d, conics, opacities, rows, valid):
    """Centre, conic, bound of 2 sigma and determinant of the splats in `rows`."""
    x = tl.load(means2d + rows * 2, mask=valid, other=0.0)
    y = tl.load(means2d + rows * 2 + 1, mask=valid, other=0.0)
    a = tl.load(conics + rows * 3, mask=valid, other=1.0)
    b = tl.load(conics + rows * 3 + 1, mask=valid, other=0.0)
    c = tl.load(conics + rows * 3 + 2, mask=valid, other=1.0)
    opacity = tl.load(opacities + rows, mask=valid, other=0.0)
    bound = 2.0 * (tl.log(255.0 * opacity) + SLACK)
    # The determinant of a long splat is a small difference of large products.
    det = (a.to(tl.float64) * c.to(tl.float64) - b.to(tl.float64) * b.to(tl.float64)).to(tl.float32)
    return x, y, a, b, c, bound, det


@triton.jit
def _box(x, y, radii, rows, valid, width, height, RADII: tl.constexpr):
    """First and end of the columns and rows of gsplat's tiles around a splat."""
    center_x, center_y = x / TILE, y / TILE
    reach_x = tl.load(radii + rows * RADII, mask=valid, other=0).to(tl.float32) / TILE
    reach_y = tl.load(radii + rows * RADII + (RADII - 1), mask=valid, other=0).to(tl.float32) / TILE
    left = tl.minimum(tl.maximum(tl.floor(center_x - reach_x), 0.0), width).to(tl.int32)
    top = tl.minimum(tl.maximum(tl.floor(center_y - reach_y), 0.0), height).to(tl.int32)
    right = tl.minimum(tl.maximum(tl.ceil(center_x + reach_x), 0.0), width).to(tl.int32)
    bottom = tl.minimum(tl.maximum(tl.ceil(center_y + reach_y), 0.0), height).to(tl.int32)
    return left, top, right, tl.where(reach_x > 0.0, bottom, top)


@triton.jit
def _columns(row, x, y, a, b, c, bound, det, left, right, SIDE: tl.constexpr):
    """First and end of the columns of tiles of a side in which a splat meets a row of tiles."""
    # Centres of the row's pixels, from the splat's.
    above = row.to(tl.float32) * SIDE + 0.5 - y
    below = above + (SIDE - 1.0)
    # Without a sure ellipse, the whole box: numbers that are not finite must show in the image.
    flat = ~(det > 0.0) | ~(tl.abs(bound) < float("inf"))
    det = tl.where(flat, 1.0, det)
    reach_x = tl.sqrt(bound * c / det)
    reach_y = tl.sqrt(bound * a / det)
    reach_y += reach_y * MARGIN + MARGIN
    meets = (above <= reach_y) & (below >= -reach_y)
    # Where the ellipse is farthest right; farthest left it is on the opposite side.
    turn = -b * reach_x / c
    at_right = tl.minimum(tl.maximum(turn, above), below)
    at_left = tl.minimum(tl.maximum(-turn, above), below)
    half_right = tl.sqrt(tl.maximum(a * bound - det * at_right * at_right, 0.0))
    half_left = tl.sqrt(tl.maximum(a * bound - det * at_left * at_left, 0.0))
    margin = reach_x * MARGIN + MARGIN
    most = x + (half_right - b * at_right) / a + margin
    least = x - (half_left + b * at_left) / a - margin
    first = tl.ceil((least - (SIDE - 0.5)) / SIDE)
    end = tl.floor((most - 0.5) / SIDE) + 1.0
    # As floats: far outside of the image they are no integers of 32 bits.
    first = tl.where(flat, left, tl.minimum(tl.maximum(first, left.to(tl.float32)), right.to(tl.float32)).to(tl.int32))
    end = tl.where(flat, right, tl.minimum(tl.maximum(end, left.to(tl.float32)), right.to(tl.float32)).to(tl.int32))
    return first, tl.where(meets | flat, tl.maximum(end, first), first)


@triton.jit(do_not_specialize=["count", "width", "height"])
def count_kernel(
    means2d, conics, opacities, radii, order, counts, count, width, height,
    SPLATS: tl.constexpr, RADII: tl.constexpr,
):  # fmt: skip
    """Number of tiles that each splat is listed in, by its place in `order`."""
    at = tl.program_id(0) * SPLATS + tl.arange(0, SPLATS)
    valid = at < count
    rows = tl.load(order + at, mask=valid, other=0)
    x, y, a, b, c, bound, det = _ellipse(means2d, conics, opacities, rows, valid)
    left, top, right, bottom = _box(x, y, radii, rows, valid, width, height, RADII)
    bottom = tl.where(valid & ~(bound <= 0.0), bottom, top)
    tiles = tl.zeros((SPLATS,), tl.int32)
    for step in range(tl.max(bottom - top, axis=0)):
        row = top + step
        first, end = _columns(row, x, y, a, b, c, bound, det, left, right, TILE)
        tiles += tl.where(row < bottom, end - first, 0)
    tl.store(counts + at, tiles, mask=valid)


@triton.jit(do_not_specialize=["count", "pairs", "width", "height"])
def list_kernel(
    means2d, conics, opacities, radii, order, ends, tiles, splats, count, pairs, width, height,
    PAIRS: tl.constexpr, RADII: tl.constexpr, SPLIT: tl.constexpr,
):  # fmt: skip
    """The tile and the splat of each pair, splats in `order`; with SPLIT, the upper four of the splat's 32 bits are for
    the tile's quarters, row by row. Pairs beyond the last, and those that rounding has left without a tile, get a tile
    below the image."""
    at = tl.program_id(0) * PAIRS + tl.arange(0, PAIRS)
    valid = at < pairs
    real = at < tl.load(ends + (count - 1))
    # The splat of a pair: how many splats end at or before it.
    low = tl.zeros((PAIRS,), tl.int32)
    high = tl.zeros((PAIRS,), tl.int32) + (count - 1)
    while tl.max(high - low, axis=0) > 0:
        middle = (low + high) // 2
        before = tl.load(ends + middle) <= at
        low = tl.where(before & (low < high), middle + 1, low)
        high = tl.where(before, high, middle)
    begin = tl.load(ends + low - 1, mask=low > 0, other=0)
    rows = tl.load(order + low)
    x, y, a, b, c, bound, det = _ellipse(means2d, conics, opacities, rows, valid)
    left, top, right, bottom = _box(x, y, radii, rows, valid, width, height, RADII)
    left_over = tl.where(real, at - begin, -1).to(tl.int32)  # tiles of the splat before the pair's, in rows to come
    # Spread over a row: in a single tile, spare pairs would keep its threads busy for longer than the image takes.
    tile = width * height + at % width
    row = top
    while tl.max(tl.where(row < bottom, left_over, -1), axis=0) >= 0:
        first, end = _columns(row, x, y, a, b, c, bound, det, left, right, TILE)
        here = (left_over >= 0) & (left_over < end - first)
        tile = tl.where(here, row * width + first + left_over, tile)
        left_over = tl.where(here, -1, left_over - tl.where(left_over >= 0, end - first, 0))
        row += 1
    rows = rows.to(tl.int32)
    if SPLIT:
        for quarter in tl.static_range(4):
            row, column = tile // width * 2 + quarter // 2, tile % width * 2 + quarter % 2
            first, end = _columns(row, x, y, a, b, c, bound, det, left * 2, right * 2, TILE // 2)
            rows |= ((first <= column) & (column < end)).to(tl.int32) << (quarter + 28)
    tl.store(tiles + at, (tile + FIRST).to(tl.int16), mask=valid)
    tl.store(splats + at, rows, mask=valid)


@triton.jit(do_not_specialize=["width", "height"])
def split_kernel(begins, splats, places, lists, width, height, BATCH: tl.constexpr, COUNT: tl.constexpr):
    """With COUNT, the length of the list of each quarter of a tile, one place behind its own in `places`; otherwise the
    list, from its place on. Width and height of the image in quarters."""
    tile = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    quarter = tl.arange(0, 4)[:, None]
    row, column = tl.program_id(1) * 2 + quarter // 2, tl.program_id(0) * 2 + quarter % 2
    inside = (row < height) & (column < width)
    places += row * width + column
    place = tl.zeros((4, 1), tl.int32) if COUNT else tl.load(places, mask=inside, other=0)
    end = tl.load(begins + tile + 1)
    for start in range(tl.load(begins + tile), end, BATCH):
        at = start + tl.arange(0, BATCH)[None, :]
        splat = tl.load(splats + at, mask=at < end, other=0)
        # A quarter's bit moves to 16 bits of its own, so that one sum counts in all quarters.
        draws = (splat >> 28 & 15).to(tl.int64) * 0x200040008001 & 0x1000100010001
        if not COUNT:
            before = tl.cumsum(draws, 1) - draws >> 16 * quarter & 0xFFFF
            tl.store(lists + (place + before), splat & 0xFFFFFFF, mask=inside & (draws >> 16 * quarter & 1 > 0))
        place += (tl.sum(draws, axis=1, keep_dims=True) >> 16 * quarter & 0xFFFF).to(tl.int32)
    if COUNT:
        tl.store(places + 1, place, mask=inside)


_THREAD = threading.local()
"""`room`, where one is in use: a viewer's thread draws other images than a training's."""


class Room:
    """Constant room for `pairs` of splats and tiles on a device, for a CUDA graph.

    Only the GPU knows how many pairs an image has, and a graph cannot wait for the number: its owner checks it after
    the graph has run.
    """

    def __init__(self, pairs: int, device: torch.device):
        self.pairs = pairs
        self.counted = torch.full((2,), -1, dtype=torch.int64, device=device)
        """pairs of the last image, and the most of any; -1 before the first"""

    def keep(self, total: Tensor) -> None:
        """Keep an image's number of pairs [1], on the GPU."""
        self.counted[:1].copy_(total)
        torch.maximum(self.counted[1:], total, out=self.counted[1:])

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Use this room for the images of this thread."""
        _THREAD.room = self
        try:
            yield
        finally:
            del _THREAD.room


def tile_lists(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    conics: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    split: bool = False,
) -> tuple[Tensor, Tensor]:
    """Lists of one camera's tiles, in the thread's `Room` if one is in use. All tensors are contiguous.

    Args:
        means2d, depths, conics: a `Projection`'s, M >= 1 rows; if split, fewer than 2^28.
        radii: half the sides, in pixels, of the boxes that bound the splats: of squares [M] or of rectangles [M, 2].
        opacities: as composited, compensation included, [M].
        width, height: image size in tiles; with the row below, at most 2^16 that are not split.
        split: tiles have half of gsplat's side: the lists of gsplat's tiles, for which there is room, are split.

    Returns:
        Where each tile's splats begin, int32 [1, height + 1, width], the last row for tiles below the image; rows of
        the splats, tile by tile, int32. Without enough room some pairs are missing. Split: what follows the last row
        is not set, and not for gsplat's kernels, which would read it.
    """
    if split:
        size, width, height = (width, height), -(-width // 2), -(-height // 2)
    count, device, axes = len(depths), depths.device, 1 if radii.dim() == 1 else 2
    order = torch.sort(depths, stable=True).indices
    counts = torch.empty(count, dtype=torch.int32, device=device)
    splats = means2d, conics, opacities, radii, order
    grid = (-(-count // SPLATS),)
    count_kernel[grid](*splats, counts, count, width, height, SPLATS=SPLATS, RADII=axes, num_warps=2)
    ends = counts.cumsum(0)
    room = getattr(_THREAD, "room", None)
    if room is None:
        pairs = int(ends[-1])
    else:
        room.keep(ends[-1:])
        pairs = room.pairs
    tiles, rows = (torch.empty(pairs, dtype=dtype, device=device) for dtype in (torch.int16, torch.int32))
    if pairs > 0:
        list_kernel[(-(-pairs // PAIRS),)](
            *splats, ends, tiles, rows, count, pairs, width, height,
            PAIRS=PAIRS, RADII=axes, SPLIT=split, num_warps=4,
        )  # fmt: skip
    tiles, by_tile = torch.sort(tiles, stable=True)
    numbers = torch.arange(FIRST.value, FIRST.value + width * (height + 1), dtype=torch.int16, device=device)
    begins = torch.searchsorted(tiles, numbers, out_int32=True)
    rows = rows.index_select(0, by_tile)
    if not split:
        return begins.view(1, height + 1, width), rows
    places = rows.new_zeros(size[1] + 1, size[0])
    lists = rows.new_empty(4 * pairs)
    split_kernel[(width, height)](begins, rows, places, lists, *size, BATCH=BATCH, COUNT=True, num_warps=2)
    places = places.flatten().cumsum(0, dtype=torch.int32).view(1, *places.shape)
    split_kernel[(width, height)](begins, rows, places, lists, *size, BATCH=BATCH, COUNT=False, num_warps=2)
    return places, lists
