# SPDX-License-Identifier: Apache-2.0
r"""Compositing: the splats of each pixel, blended front to back, and its derivative.

Forward. Splat k (nearest first) covers a pixel centre x with

    alpha_k = min(0.999, exp(l_k)),    l_k = ln o_k - sigma_k,    sigma_k = (x - m_k)^T Q_k (x - m_k) / 2,

counted as 0 below 1/255. What is left of the light behind it is T_k = T_{k-1} (1 - alpha_k), T_0 = 1. The first splat that would
push T_k to 1e-4 or below ends the pixel: it and all behind it are not drawn. With the odds r_k = alpha_k / (1 - alpha_k)

    C = sum_k w_k c_k,    A = 1 - T_n,    w_k = alpha_k T_{k-1} = r_k T_k                     (n: last drawn splat).

Written around the centre of the pixel's tile, with x the offset from it and m_k = (mx, my) the splat's,

    l_k(x) = [ln o - s] + gx x + gy y - (a/2) x^2 - b xy - (c/2) y^2,     (gx, gy) = Q_k m_k,    s = m_k . (gx, gy) / 2,

which is linear in (1, x, y, x^2, xy, y^2). Those six numbers are the same for every tile, so the l of all splats at all 64
pixels is one matrix product. The six coefficients are formed in float64: they are where a needle far from its tile cancels.

Backward. Let e_k = c_k . dL/dC and b = -dL/dA, and let S_k be the part of the loss that is seen through splat k:

    S_k = T_n b + sum_{j > k} w_j e_j            (T_n b because A = 1 - T_n).

Splat k adds w_k e_k = alpha_k T_{k-1} e_k and dims all of S_k by (1 - alpha_k), so

    dL/dalpha_k = T_{k-1} e_k - S_k / (1 - alpha_k),
    dL/dl_k     = alpha_k dL/dalpha_k = w_k e_k - r_k S_k,        S_{k-1} = S_k + w_k e_k,

run from back to front. It vanishes by itself where alpha is 0, and is set to 0 where alpha is capped; dL/dc_k = sum_x w_k dL/dC.
With v = dL/dl_k at each pixel, d = x - m, and sums over the tile's pixels, which six moments of v deliver,

    dL/dln o = sum v,    dL/dm = sum v Q d,    dL/d(a, b, c) = -sum v (dx^2 / 2, dx dy, dy^2 / 2),

and absgrad is sum |v Q d|, the only one that needs a pass of its own.

Order of work. Tiles advance together in *slabs* of 64 splats of depth. After each slab the tiles that have run out of splats
or of light leave, so hidden splats cost nothing. A slab is cut into batches of tiles with similar counts whose
arrays [B, n, 64] stay within `BATCH_ELEMENTS`, the memory knob of the arithmetic; `BLOCK_PAIRS` in turn bounds
the lists. Nothing per pixel is stored for the backward pass but T at the start of each slab.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from ..contract import Projection
from .tiles import MIN_ALPHA, Footprints, TileLists, footprints, list_tiles, split_into_blocks

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a pixel ends before T falls to this
SLAB = 64  # splats of depth between two looks at which tiles are finished
BATCH_ELEMENTS = 2**20  # pixels x splats in flight; about five float arrays of this size exist at a time
BLOCK_PAIRS = 2**22  # (tile, splat) pairs listed at a time; about 100 bytes each
NOTHING = -1e5  # exp(NOTHING) = 0: the log-alpha of padding


@dataclass
class _Batch:
    """Tiles that are composited together over one slab: B tiles, n splats each, P pixels per tile."""

    tiles: Tensor  # [B] positions in TileLists.tiles
    first: int  # depth of the slab's first splat
    depth: int  # n
    transmittance: Tensor  # T where the slab begins; 0 in finished pixels. [B, P]


class _Sheet:
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

    def centres(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates of the centres of tiles. [B] each, float64"""
        edge, tiles_x, tiles_y = self.prints.edge, self.prints.tiles_x, self.prints.tiles_y
        x, y = tiles % tiles_x, tiles // tiles_x % tiles_y
        return (x.double() + 0.5) * edge, (y.double() + 0.5) * edge

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


class _Slice:
    """The splats of a batch with their coefficients of l; rows are (tile, splat), B * n of them."""

    def __init__(self, sheet: _Sheet, lists: TileLists, batch: _Batch) -> None:
        depth = torch.arange(batch.first, batch.first + batch.depth)
        pair = lists.start.index_select(0, batch.tiles)[:, None] + depth
        self.listed = depth < lists.count.index_select(0, batch.tiles)[:, None]  # [B, n]
        self.pair = pair.clamp_(max=lists.splat.numel() - 1)
        self.splat = lists.splat.index_select(0, self.pair.flatten())  # [B * n]
        tile_x, tile_y = sheet.centres(lists.tiles.index_select(0, batch.tiles))

        shape = sheet.prints.shape.index_select(0, self.splat).view(*pair.shape, 6)
        x, y, a, b, c, log_opacity = shape.unbind(-1)
        mx, my = x - tile_x[:, None], y - tile_y[:, None]
        gx, gy = a * mx + b * my, b * mx + c * my
        peak = torch.where(self.listed, log_opacity - 0.5 * (mx * gx + my * gy), NOTHING)
        dtype = sheet.colors.dtype
        self.centre = torch.stack([mx, my], dim=-1).to(dtype)  # [B, n, 2]
        self.coefficients = torch.stack([peak, gx, gy, -0.5 * a, -b, -0.5 * c], dim=-1).to(dtype)  # [B, n, 6]
        self.colors = sheet.colors.index_select(0, self.splat).view(*pair.shape, -1)  # [B, n, D]
        self.may_cap = bool(log_opacity.max() > -1e-3)  # ln 0.999 = -1.0005e-3


def _blend(sheet: _Sheet, piece: _Slice, batch: _Batch) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """Odds r_k (0 where splat k is not drawn) and T_k of a batch. [B, n, P] each

    Also where alpha is capped and where the pixel has ended, [B, n, P], or None where that happens nowhere.
    """
    n_tiles, n = piece.listed.shape
    alpha = (piece.coefficients.view(-1, 6) @ sheet.basis).view(n_tiles, n, -1).exp_()
    F.threshold_(alpha, _just_below(MIN_ALPHA, alpha.dtype), 0.0)
    capped = None
    if piece.may_cap:
        capped = alpha > MAX_ALPHA
        alpha.clamp_(max=MAX_ALPHA)
    transmittance = 1 - alpha
    odds = alpha.div_(transmittance)
    before = batch.transmittance
    for through in transmittance.unbind(1):
        before = torch.mul(through, before, out=through)
    ended = None
    if before.min() <= MIN_TRANSMITTANCE:
        ended = transmittance <= MIN_TRANSMITTANCE
        odds.masked_fill_(ended, 0.0)
    return odds, transmittance, capped, ended


def _just_below(value: float, dtype: torch.dtype) -> float:
    """The largest number of a type below a value of that type, as threshold_ keeps what is strictly greater."""
    value = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(value, torch.zeros_like(value)))


def _batches(remaining: Tensor, tiles: Tensor, pixels: int) -> list[Tensor]:
    """Cut tiles, sorted by falling number of splats, into groups of similar numbers within BATCH_ELEMENTS."""
    counts = remaining.tolist()
    groups, begin = [], 0
    while begin < len(counts):
        end = min(len(counts), begin + max(1, BATCH_ELEMENTS // (counts[begin] * pixels)))
        enough = 0.75 * counts[begin] - 4  # bounds the padding to a quarter, or four splats
        while counts[end - 1] < enough:
            end -= 1
        groups.append(tiles[begin:end])
        begin = end
    return groups


def _sweep(sheet: _Sheet, lists: TileLists, final: Tensor, render: Tensor | None) -> list[_Batch]:
    """Composite one block front to back.

    Args:
        final: transmittance behind the last drawn splat, updated in place. [C * tiles, P]
        render: colours, added in place; None repeats a sweep for its transmittances only. [C * tiles, D, P]

    Returns:
        The batches in the order of work: all that the backward pass needs.
    """
    record = []
    live = sheet.inside.index_select(0, lists.tiles)  # T, or 0 in finished pixels. [L, P]
    active = torch.arange(lists.tiles.numel())
    first = 0
    while active.numel() > 0:
        remaining = (lists.count.index_select(0, active) - first).clamp(max=SLAB)
        remaining, by_count = torch.sort(remaining, descending=True)
        active = active.index_select(0, by_count)
        for tiles in _batches(remaining, active, live.shape[1]):
            depth = min(SLAB, int(lists.count[tiles[0]]) - first)
            batch = _Batch(tiles, first, depth, live.index_select(0, tiles))
            record.append(batch)
            piece = _Slice(sheet, lists, batch)
            odds, transmittance, _, ended = _blend(sheet, piece, batch)
            weights = odds.mul_(transmittance)
            where = lists.tiles.index_select(0, tiles)
            if render is not None:
                render[where] += torch.bmm(piece.colors.transpose(1, 2), weights)
            after = transmittance[:, -1]
            if ended is not None:
                after = transmittance.masked_fill_(ended, 2.0).amin(1).minimum(final.index_select(0, where))
            final[where] = after
            live[tiles] = after if ended is None else after.masked_fill(ended[:, -1], 0.0)
        first += SLAB
        unfinished = (lists.count.index_select(0, active) > first) & (live.index_select(0, active) > 0).any(1)
        active = active[unfinished]
    return record


def _backward_batch(
    sheet: _Sheet, lists: TileLists, batch: _Batch, grad: Tensor, behind: Tensor, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Gradients of one batch with respect to its splats.

    Args:
        grad: dL/dC of its tiles. [B, D, P]
        behind: S of the last splat; becomes S before the first, in place. [B, P]

    Returns:
        The slots [R] and rows [R, 6 + D (+ 2)] of the listed (tile, splat) pairs: gradients of centre x, y, conic a, b, c, ln o,
        colours, and absolute gradients of the centre.
    """
    piece = _Slice(sheet, lists, batch)
    odds, transmittance, capped, _ = _blend(sheet, piece, batch)
    weights = transmittance.mul_(odds)
    grad_colors = torch.bmm(weights, grad.transpose(1, 2))  # [B, n, D]
    seen = torch.bmm(piece.colors, grad).mul_(weights)  # w_k e_k
    for own, r in zip(reversed(seen.unbind(1)), reversed(odds.unbind(1)), strict=True):
        torch.addcmul(own, r, behind, value=-1, out=r)
        behind += own
    v = odds  # dL/dl
    if capped is not None:
        v.masked_fill_(capped, 0.0)

    n_tiles, n = piece.listed.shape
    moments = (v.view(n_tiles * n, -1) @ sheet.basis.t()).view(n_tiles, n, 6)
    v0, vx, vy, vxx, vxy, vyy = moments.unbind(-1)
    mx, my = piece.centre.unbind(-1)
    _, gx, gy, half_a, b, half_c = piece.coefficients.unbind(-1)  # gx, gy, -a / 2, -b, -c / 2
    columns = [
        -2 * half_a * vx - b * vy - gx * v0,
        -b * vx - 2 * half_c * vy - gy * v0,
        -0.5 * (vxx - 2 * mx * vx + mx * mx * v0),
        -(vxy - mx * vy - my * vx + mx * my * v0),
        -0.5 * (vyy - 2 * my * vy + my * my * v0),
        v0,
    ]
    if absgrad:
        v = v.abs_()
        for pull in ([gx, 2 * half_a, b], [gy, b, 2 * half_c]):  # -(Q d) as a function of the pixel
            pull = (torch.stack(pull, dim=-1).view(-1, 3) @ sheet.basis[:3]).view_as(v)
            columns.append(pull.abs_().mul_(v).sum(-1))
    rows = torch.cat([torch.stack(columns[:6], dim=-1), grad_colors, *(c[..., None] for c in columns[6:])], dim=-1)
    slots = lists.slot.index_select(0, piece.pair.flatten())
    listed = piece.listed.flatten()
    if bool(listed.all()):
        return slots, rows.flatten(0, 1)
    return slots[listed], rows.flatten(0, 1)[listed]


class _Composite(torch.autograd.Function):
    """(means2d, conics, opacities, colors) -> (render [C, H, W, D], transmittance [C, H, W, 1])."""

    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, projection: Projection, tile_size: int, absgrad: bool):
        prints = footprints(projection, opacities, tile_size)
        size = (projection.n_cameras, projection.width, projection.height)
        sheet = _Sheet(prints, colors.index_select(0, prints.rows), *size)
        final = torch.ones_like(sheet.inside)
        render = final.new_zeros(sheet.n_tiles, colors.shape[1], final.shape[1])
        blocks = split_into_blocks(prints, BLOCK_PAIRS)
        records = []
        for block in blocks:
            lists = list_tiles(prints, block)
            batches = _sweep(sheet, lists, final, render)
            # With several blocks, keeping the record of each would undo the bound on memory: they are swept again.
            records.append((lists, batches) if len(blocks) == 1 else None)
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.sheet, ctx.final, ctx.blocks, ctx.records, ctx.absgrad = sheet, final, blocks, records, absgrad
        return sheet.image(render, *size), sheet.image(final[:, None], *size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_render: Tensor, grad_transmittance: Tensor):
        means2d, conics, opacities, colors = ctx.saved_tensors
        sheet, final = ctx.sheet, ctx.final
        grad = sheet.tiled(grad_render)
        behind = final * sheet.tiled(grad_transmittance).squeeze(1)  # S behind the last drawn splat: T_n dL/dT_n
        channels = colors.shape[1]
        n_columns = 6 + channels + (2 if ctx.absgrad else 0)
        total = final.new_zeros(means2d.shape[0], n_columns)
        for block, record in zip(ctx.blocks, ctx.records, strict=True):
            if record is None:
                lists = list_tiles(sheet.prints, block)
                record = lists, _sweep(sheet, lists, torch.ones_like(final), None)
            lists, batches = record
            per_pair = final.new_zeros(lists.splat.numel(), n_columns)
            for batch in reversed(batches):
                where = lists.tiles.index_select(0, batch.tiles)
                state = behind.index_select(0, where)
                slots, rows = _backward_batch(sheet, lists, batch, grad.index_select(0, where), state, ctx.absgrad)
                per_pair[slots] = rows
                behind[where] = state
            # Pairs of a splat lie in consecutive slots: one segmented sum, many times faster than a scatter.
            summed = F.embedding_bag(torch.arange(len(per_pair)), per_pair, lists.splat_start, mode="sum")
            total[sheet.prints.rows] += summed
        if ctx.absgrad:
            means2d.absgrad = total[:, -2:].contiguous()
        grad_opacities = total[:, 5] / opacities.where(opacities > 0, 1.0)
        grad_colors = total[:, 6 : 6 + channels]
        return total[:, :2].contiguous(), total[:, 2:5].contiguous(), grad_opacities, grad_colors, None, None, None


def composite(
    projection: Projection, colors: Tensor, opacities: Tensor, *, tile_size: int, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Blend colours front to back. Colours [M, D], opacities [M] -> render [C, H, W, D], transmittance [C, H, W, 1]."""
    # Half-precision arithmetic, which autocast would choose, cannot hold log-alpha.
    with torch.autocast("cpu", enabled=False):
        return _Composite.apply(
            projection.means2d, projection.conics, opacities, colors, projection, tile_size, absgrad
        )
