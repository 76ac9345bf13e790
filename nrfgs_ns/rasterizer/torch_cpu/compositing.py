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

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from ..contract import Projection
from . import batches
from .batches import LN_2, Batch, Numbers, Sheet, gather, pair_rows, similar_tiles
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
    """A batch, composited."""

    alpha: Tensor  # 0 where splat k is not drawn. [B, n, P]
    alphas: tuple[Tensor, ...]  # its n slices. [B, P] each
    weights: Tensor  # w_k = alpha_k T_{k-1}. [B, n, P]
    last: Tensor  # T behind the slab, 0 in pixels that have ended. [B, P]
    final: Tensor  # T behind the last drawn splat; meaningless in pixels that had ended before. [B, P]
    capped: tuple[Tensor, Tensor] | None  # rows (of B * n) that can exceed 0.999, and their pixels that do


def _blend(sheet: Sheet, numbers: Numbers, start: Tensor) -> _Blend:
    """The forward equations of the module docstring for one batch, from T in front of it [B, P].

    Arithmetic with zeros stands in for masks: filling by a mask costs as much as the exponential.
    """
    n_tiles, n = numbers.colors.shape[:2]
    pixels = start.shape[1]
    alpha, alphas = sheet.buffer("alpha", n_tiles, n, pixels)
    flat = alpha.view(-1, pixels)
    torch.mm(numbers.coefficients.flatten(0, 1), sheet.basis, out=flat).exp2_()
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
    weights = torch.mul(alpha, through[:, :-1], out=sheet.buffer("weights", n_tiles, n, pixels)[0])

    last = final = steps[-1].clone()
    if last.min() <= MIN_TRANSMITTANCE:
        # T never rises, so the last value above the threshold is the smallest.
        spare, _ = sheet.buffer("spare", *through.shape)
        final = torch.threshold(through, MIN_TRANSMITTANCE, 2.0, out=spare).amin(1)
        drawn = through.gt_(MIN_TRANSMITTANCE)  # 1 or 0
        last = last * drawn[:, -1]
        weights *= drawn[:, 1:]
        alpha *= drawn[:, 1:]
    return _Blend(alpha, alphas, weights, last, final, capped)


def _just_below(value: float, dtype: torch.dtype) -> float:
    """The largest number of a type below a value of that type, as threshold_ keeps what is strictly greater."""
    value = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(value, torch.zeros_like(value)))


def _sweep(sheet: Sheet, lists: TileLists, rows: Tensor, final: Tensor, render: Tensor | None) -> list[Batch]:
    """Composite one block front to back.

    Args:
        rows: see `pair_rows`. [K, 9 + D]
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
        remaining = (lists.count.index_select(0, active) - first).clamp(max=batches.SLAB)
        remaining, by_count = torch.sort(remaining, descending=True)
        active = active.index_select(0, by_count)
        for tiles in similar_tiles(remaining, active, live.shape[1]):
            n = min(batches.SLAB, int(lists.count[tiles[0]]) - first)
            batch = Batch(tiles, first, n, live.index_select(0, tiles))
            record.append(batch)
            numbers = gather(rows, *batch.pairs(lists))
            blend = _blend(sheet, numbers, batch.transmittance)
            where = lists.tiles.index_select(0, tiles)
            live.index_copy_(0, tiles, blend.last)
            final.index_copy_(0, where, blend.final.minimum(final.index_select(0, where)))
            if render is not None:
                so_far = render.index_select(0, where)
                render.index_copy_(0, where, so_far.baddbmm_(numbers.colors.transpose(1, 2), blend.weights))
        first += batches.SLAB
        unfinished = (lists.count.index_select(0, active) > first) & (live.index_select(0, active) > 0).any(1)
        active = active[unfinished]
    return record


def _backward_batch(
    sheet: Sheet, numbers: Numbers, start: Tensor, grad: Tensor, behind: Tensor, absgrad: bool
) -> Tensor:
    """Gradients of one batch with respect to its splats: the backward equations of the module docstring.

    Args:
        start: T in front of the batch. [B, P]
        grad: dL/dC of its tiles. [B, D, P]
        behind: U of the last splat; becomes U in front of the first, in place. [B, P]

    Returns:
        Gradients of centre x, y, conic a, b, c, ln o, colours, then absgrad. [B, n, 6 + D (+ 2)]
    """
    blend = _blend(sheet, numbers, start)
    n_tiles, n, pixels = blend.alpha.shape
    worth, each_worth = sheet.buffer("spare", n_tiles, n, pixels)
    torch.bmm(numbers.colors, grad, out=worth)  # e_k
    beyond, steps = sheet.buffer("through", n_tiles, n + 1, pixels)  # U_0 ... U_n
    steps[-1].copy_(behind)
    for k in range(n - 1, -1, -1):
        torch.lerp(steps[k + 1], each_worth[k], blend.alphas[k], out=steps[k])
    behind.copy_(steps[0])
    v = worth.sub_(beyond[:, 1:]).mul_(blend.weights)  # dL/dl
    if blend.capped is not None:
        where, pixels_capped = blend.capped
        v.view(-1, pixels)[where] *= ~pixels_capped

    channels = numbers.colors.shape[-1]
    gradients = v.new_empty(n_tiles, n, 6 + channels + 2 * absgrad)
    v0, vx, vy, vxx, vxy, vyy = (v.view(-1, pixels) @ sheet.basis.t()).view(n_tiles, n, 6).unbind(-1)
    mx, my = numbers.centres.unbind(-1)
    _, gx, gy, half_a, b, half_c = numbers.coefficients.unbind(-1)  # peak, gx, gy, -a / 2, -b, -c / 2, all over ln 2
    a, c = 2 * half_a, 2 * half_c
    dx, dy = vx - mx * v0, vy - my * v0  # sums of v dx, v dy
    gradients[..., 0] = -LN_2 * (a * vx + b * vy + gx * v0)
    gradients[..., 1] = -LN_2 * (b * vx + c * vy + gy * v0)
    gradients[..., 2] = -0.5 * (vxx - mx * (vx + dx))
    gradients[..., 3] = my * vx + mx * dy - vxy
    gradients[..., 4] = -0.5 * (vyy - my * (vy + dy))
    gradients[..., 5] = v0
    gradients[..., 6 : 6 + channels] = torch.bmm(blend.weights, grad.transpose(1, 2))
    if absgrad:
        size = v.abs_()
        for axis, pull in enumerate(([gx, a, b], [gy, b, c])):  # -Q d is linear in the pixel
            pulls, _ = sheet.buffer("through", n_tiles, n, pixels)
            torch.mm(torch.stack(pull, dim=-1).view(-1, 3), sheet.basis[:3], out=pulls.view(-1, pixels))
            gradients[..., 6 + channels + axis] = LN_2 * pulls.abs_().mul_(size).sum(-1)
    return gradients


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
            rows = pair_rows(sheet, lists)
            work = _sweep(sheet, lists, rows, final, render)
            # With several blocks, keeping the record of each would undo the bound on memory: they are swept again.
            records.append((lists, rows, work) if len(blocks) == 1 else None)
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
                rows = pair_rows(sheet, lists)
                record = lists, rows, _sweep(sheet, lists, rows, torch.ones_like(sheet.inside), None)
            lists, rows, work = record
            per_pair = grad.new_zeros(lists.splat.numel(), n_columns)
            for batch in reversed(work):
                where = lists.tiles.index_select(0, batch.tiles)
                state = behind.index_select(0, where)
                pairs, listed = batch.pairs(lists)
                numbers = gather(rows, pairs, listed)
                gradients = _backward_batch(
                    sheet, numbers, batch.transmittance, grad.index_select(0, where), state, ctx.absgrad
                )
                slots, gradients = lists.slot.index_select(0, pairs.flatten()), gradients.flatten(0, 1)
                if not listed[-1, -1]:  # the last tile of a batch has the fewest splats
                    listed = listed.flatten().nonzero().squeeze(1)
                    slots, gradients = slots.index_select(0, listed), gradients.index_select(0, listed)
                per_pair.index_copy_(0, slots, gradients)
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
    return _Composite.apply(projection.means2d, projection.conics, opacities, colors, projection, tile_size, absgrad)
