# SPDX-License-Identifier: Apache-2.0
r"""Compositing: the splats of each pixel, blended front to back, and its derivative.

Forward. Splat k (nearest first) covers a pixel centre x with

    alpha_k = min(0.999, exp(l_k)),    l_k = ln o_k - sigma_k,    sigma_k = (x - m_k)^T Q_k (x - m_k) / 2,

counted as 0 below 1/255. What is left of the light behind it is T_k = T_{k-1} (1 - alpha_k), T_0 = 1. The first splat
that would push T_k to 1e-4 or below ends the pixel: it and all behind it are not drawn, as if their alpha were 0. Then

    C = sum_k w_k c_k,    A = 1 - T_n,    w_k = alpha_k T_{k-1}.

Written around the centre of the pixel's tile, with x the offset from it and m_k = (mx, my) the splat's,

    l_k(x) = [ln o - s] + gx x + gy y - (a/2) x^2 - b xy - (c/2) y^2,     (gx, gy) = Q_k m_k,    s = m_k . (gx, gy) / 2,

which is linear in (1, x, y, x^2, xy, y^2). Those six numbers are the same for every tile, so the l of all splats at
all 64 pixels is one matrix product. The six coefficients are formed in float64: they are where a needle far from its
tile cancels.

Backward. The derivative of the loss L with respect to the light that arrives behind splat k is

    U_k = dL/dT_k,      U_n = dL/dT_n = -dL/dA,

and splat k splits the light that reaches it: alpha_k of it meets the colour c_k, which is worth e_k = c_k . dL/dC, the
rest goes on and is worth U_k. So, from back to front,

    U_{k-1}     = (1 - alpha_k) U_k + alpha_k e_k,
    dL/dalpha_k = T_{k-1} (e_k - U_k),
    dL/dl_k     = alpha_k dL/dalpha_k = w_k (e_k - U_k),        dL/dc_k = sum over pixels of w_k dL/dC.

Nothing is divided and nothing large cancels. dL/dl_k is 0 by itself where splat k is not drawn, and is set to 0 where
alpha is capped. With v = dL/dl_k at each pixel, d = x - m, and sums over the tile's pixels, which six moments of v
deliver,

    dL/dln o = sum v,    dL/dm = sum v Q d,    dL/d(a, b, c) = -sum v (dx^2 / 2, dx dy, dy^2 / 2),

and absgrad is sum |v Q d|, the only one that needs a pass of its own.

How the work is cut up is the business of `batches`.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from ..contract import Projection
from . import batches
from .batches import LN_2, Batch, Numbers, Sheet, expand, pairs_of, similar_tiles
from .tiles import MIN_ALPHA, TileLists, footprints, list_tiles, split_into_blocks

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a pixel ends before T falls to this
BLOCK_PAIRS = 2**21  # (tile, splat) pairs listed at a time; about 200 bytes each, forward and backward


@contextmanager
def full_precision() -> Iterator[None]:
    """Keep matrix products in the precision of their operands, whatever autocast or the matmul precision ask for.

    log-alpha reaches tens and is then exponentiated: bfloat16 would be wrong by whole factors. Both settings reach CPU
    products (the second through oneDNN), so both are suspended here.
    """
    enabled = torch.backends.mkldnn.enabled
    torch.backends.mkldnn.enabled = False
    try:
        with torch.autocast("cpu", enabled=False):
            yield
    finally:
        torch.backends.mkldnn.enabled = enabled


@dataclass
class _Blend:
    """A batch, composited. Most of it is scratch memory, which the next batch overwrites."""

    alpha: Tensor  # 0 where splat k is not drawn, but for pixels that had ended before. [B, n, P]
    alphas: tuple[Tensor, ...]  # its n slices. [B, P] each
    through: Tensor  # T_0 ... T_n as if no pixel ended. [B, n + 1, P]
    weights: Tensor  # w_k = alpha_k T_{k-1}. [B, n, P]
    last: Tensor  # T behind the slab, 0 in pixels that have ended. [B, P]
    drawn: Tensor | None  # 1 where splat k is drawn, else 0; None if no pixel ends in this slab. [B, n, P]
    capped: tuple[Tensor, Tensor] | None  # rows (of B * n) that can exceed 0.999, and their pixels that do


def _blend(sheet: Sheet, numbers: Numbers, start: Tensor) -> _Blend:
    """The forward equations of the module docstring for one batch, from T in front of it [B, P].

    Arithmetic with zeros stands in for masks: filling by a mask costs as much as the exponential.
    """
    n_tiles, n = numbers.colors.shape[:2]
    pixels = start.shape[1]
    alpha, alphas = sheet.buffer("alpha", n_tiles, n, pixels)
    flat = alpha.view(-1, pixels)
    torch.mm(numbers.coefficients.t(), sheet.basis, out=flat).exp2_()
    F.threshold_(flat, _just_below(MIN_ALPHA, flat.dtype), 0.0)
    capped = None
    if numbers.strong.numel() > 0:
        strong = flat.index_select(0, numbers.strong)
        capped = numbers.strong, strong > MAX_ALPHA
        flat.index_copy_(0, numbers.strong, strong.clamp_(max=MAX_ALPHA))

    through, steps = sheet.buffer("through", n_tiles, n + 1, pixels)  # T_0 ... T_n
    steps[0].copy_(start)
    for before, own, after in zip(steps, alphas, steps[1:], strict=False):
        torch.addcmul(before, own, before, value=-1, out=after)  # T_k = T_{k-1} - alpha_k T_{k-1}

    drawn, last = None, F.threshold(steps[-1], MIN_TRANSMITTANCE, 0.0)
    if last.count_nonzero() < start.count_nonzero():  # T may also have underflowed, so `last` alone does not tell
        drawn = torch.gt(through[:, 1:], MIN_TRANSMITTANCE, out=sheet.buffer("spare", n_tiles, n, pixels)[0])
        alpha *= drawn
    weights = torch.mul(alpha, through[:, :-1], out=sheet.buffer("weights", n_tiles, n, pixels)[0])
    return _Blend(alpha, alphas, through, weights, last, drawn, capped)


@functools.cache
def _just_below(value: float, dtype: torch.dtype) -> float:
    """The largest number of a type below a value of that type, as threshold_ keeps what is strictly greater."""
    value = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(value, torch.zeros_like(value)))


def _sweep(sheet: Sheet, lists: TileLists, final: Tensor, render: Tensor | None) -> list[Batch]:
    """Composite one block front to back.

    Args:
        final: transmittance behind the last drawn splat, set for the tiles that have splats. [C * tiles, P]
        render: colours, added in place; None repeats a sweep for its batches only. [C * tiles, D, P]

    Returns:
        The batches in the order of work: all that the backward pass needs.
    """
    record = []
    live = sheet.inside.index_select(0, lists.tiles)  # T, or 0 in finished pixels. [L, P]
    ended = torch.zeros_like(live)  # T where a pixel ended, or 0 in live pixels
    centres = sheet.centres(lists.tiles)
    active = torch.arange(lists.tiles.numel())
    first = 0
    while active.numel() > 0:
        remaining = (lists.count.index_select(0, active) - first).clamp(max=batches.SLAB)
        remaining, by_count = torch.sort(remaining, descending=True)
        active = active.index_select(0, by_count)
        for tiles, n in similar_tiles(remaining, active, live.shape[1]):
            pairs = pairs_of(lists, tiles, first, n)
            numbers = expand(sheet, lists, centres.index_select(1, tiles), pairs)
            batch = Batch(tiles, pairs, numbers, live.index_select(0, tiles))
            record.append(batch)
            blend = _blend(sheet, numbers, batch.transmittance)
            live.index_copy_(0, tiles, blend.last)
            if blend.drawn is not None:
                n_drawn = blend.drawn.sum(1, keepdim=True).long()
                left = blend.through.gather(1, n_drawn).squeeze(1)
                ended.index_add_(0, tiles, left.sub_(blend.last))
            if render is not None:
                where = lists.tiles.index_select(0, tiles)
                so_far = render.index_select(0, where)
                render.index_copy_(0, where, so_far.baddbmm_(numbers.colors.transpose(1, 2), blend.weights))
        first += batches.SLAB
        unfinished = (lists.count.index_select(0, active) > first) & (live.index_select(0, active).amax(1) > 0)
        active = active[unfinished]
    final.index_copy_(0, lists.tiles, live + ended)
    return record


def _backward_batch(
    sheet: Sheet, batch: Batch, grad: Tensor, behind: Tensor, absgrad: bool, gradients: Tensor
) -> Tensor:
    """Gradients of one batch with respect to its splats: the backward equations of the module docstring.

    Args:
        grad: dL/dC of its tiles. [B, D, P]
        behind: U of the last splat. [B, P]
        gradients: receives those of centre x, y, conic a, b, c, ln o, colours, then absgrad. [B * n, 6 + D (+ 2)]

    Returns:
        U in front of the first splat. [B, P]
    """
    numbers, start = batch.numbers, batch.transmittance
    blend = _blend(sheet, numbers, start)
    n_tiles, n, pixels = blend.alpha.shape
    worth, each_worth = sheet.buffer("spare", n_tiles, n, pixels)
    torch.bmm(numbers.colors, grad, out=worth)  # e_k
    beyond, steps = sheet.buffer("through", n_tiles, n + 1, pixels)  # U_0 ... U_n
    steps[-1].copy_(behind)
    for k in range(n - 1, -1, -1):
        torch.lerp(steps[k + 1], each_worth[k], blend.alphas[k], out=steps[k])
    in_front = torch.where(start > 0, steps[0], behind)
    v = worth.sub_(beyond[:, 1:]).mul_(blend.weights).view(-1, pixels)  # dL/dl
    if blend.capped is not None:
        where, pixels_capped = blend.capped
        v[where] *= ~pixels_capped

    channels = numbers.colors.shape[-1]
    v0, vx, vy, vxx, vxy, vyy = sheet.basis @ v.t()
    mx, my = numbers.centres
    _, gx, gy, half_a, b, half_c = numbers.coefficients  # peak, gx, gy, -a / 2, -b, -c / 2, all over ln 2
    a, c = 2 * half_a, 2 * half_c
    dx, dy = vx - mx * v0, vy - my * v0  # sums of v dx, v dy
    gradients[:, 0] = -LN_2 * (a * vx + b * vy + gx * v0)
    gradients[:, 1] = -LN_2 * (b * vx + c * vy + gy * v0)
    gradients[:, 2] = -0.5 * (vxx - mx * (vx + dx))
    gradients[:, 3] = my * vx + mx * dy - vxy
    gradients[:, 4] = -0.5 * (vyy - my * (vy + dy))
    gradients[:, 5] = v0
    of_colors = torch.bmm(grad, blend.weights.transpose(1, 2))  # [B, D, n]
    gradients[:, 6 : 6 + channels].view(n_tiles, n, channels).copy_(of_colors.transpose(1, 2))
    if absgrad:
        size = v.abs_()
        for axis, pull in enumerate(([gx, a, b], [gy, b, c])):  # -Q d is linear in the pixel
            pulls = sheet.buffer("through", n_tiles, n, pixels)[0].view(-1, pixels)
            torch.mm(torch.stack(pull).t(), sheet.basis[:3], out=pulls)
            gradients[:, 6 + channels + axis] = LN_2 * pulls.abs_().mul_(size).sum(-1)
    return in_front


class _Composite(torch.autograd.Function):
    """(means2d, conics, opacities, colors) -> (render [C, H, W, D], transmittance [C, H, W, 1])."""

    @staticmethod
    @full_precision()
    def forward(ctx, means2d, conics, opacities, colors, projection: Projection, tile_size: int, absgrad: bool):
        prints = footprints(projection, opacities, tile_size)
        size = (projection.n_cameras, projection.width, projection.height)
        sheet = Sheet(prints, colors.index_select(0, prints.rows), *size)
        final = torch.ones_like(sheet.inside)
        render = final.new_zeros(sheet.n_tiles, colors.shape[1], final.shape[1])
        blocks = split_into_blocks(prints, BLOCK_PAIRS)
        records = []
        for block in blocks:
            lists = list_tiles(prints, block)
            work = _sweep(sheet, lists, final, render)
            # With several blocks, keeping the record of each would undo the bound on memory: they are swept again.
            records.append((lists, work) if len(blocks) == 1 else None)
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.sheet, ctx.blocks, ctx.records, ctx.absgrad = sheet, blocks, records, absgrad
        return sheet.image(render, *size), sheet.image(final[:, None], *size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    @full_precision()
    def backward(ctx, grad_render: Tensor, grad_transmittance: Tensor):
        means2d, conics, opacities, colors = ctx.saved_tensors
        sheet = ctx.sheet
        grad = sheet.tiled(grad_render)
        behind = sheet.tiled(grad_transmittance).squeeze(1).clone()  # U behind the last drawn splat
        channels = colors.shape[1]
        n_columns = 6 + channels + (2 if ctx.absgrad else 0)
        total = grad.new_zeros(means2d.shape[0], n_columns)
        for block, record in zip(ctx.blocks, ctx.records, strict=True):
            if record is None:
                lists = list_tiles(sheet.prints, block)
                record = lists, _sweep(sheet, lists, torch.empty_like(sheet.inside), None)
            lists, work = record
            # Gradients in the order of work, and the row of each slot; pairs that no batch reached share a row of 0.
            n_pairs, end = lists.splat.numel(), sum(batch.pairs.numel() for batch in work)
            gradients = grad.new_empty(end + 1, n_columns)
            gradients[end] = 0
            slot = torch.cat([lists.slot, lists.slot.new_tensor([n_pairs])])  # padding has one of its own
            row_of_slot = torch.full((n_pairs + 1,), end)
            for batch in reversed(work):
                where = lists.tiles.index_select(0, batch.tiles)
                begin = end - batch.pairs.numel()
                behind[where] = _backward_batch(
                    sheet,
                    batch,
                    grad.index_select(0, where),
                    behind.index_select(0, where),
                    ctx.absgrad,
                    gradients[begin:end],
                )
                slots = slot.index_select(0, batch.pairs.flatten())
                row_of_slot.index_copy_(0, slots, torch.arange(begin, end))
                end = begin
            # Pairs of a splat lie in consecutive slots: one segmented sum, many times faster than a scatter.
            summed = F.embedding_bag(row_of_slot[:n_pairs], gradients, lists.splat_start, mode="sum")
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
    return _Composite.apply(projection.means2d, projection.conics, opacities, colors, projection, tile_size, absgrad)
