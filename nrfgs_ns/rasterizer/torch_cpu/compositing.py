# SPDX-License-Identifier: Apache-2.0
r"""Compositing: the splats of each pixel, blended front to back, and its derivative.

Forward. Splat k (nearest first) covers a pixel centre x with

    alpha_k = min(0.999, exp(l_k)),    l_k = ln o_k - sigma_k,    sigma_k = (x - m_k)^T Q_k (x - m_k) / 2,

counted as 0 below 1/255. The light that is left behind it is T_k = T_{k-1} (1 - alpha_k), T_0 = 1. The first splat
that would push T_k to 1e-4 or below ends the pixel: it and all behind it are not drawn, as if their alpha were 0. Then

    C = sum_k w_k c_k,    A = 1 - T_n,    w_k = alpha_k T_{k-1}.

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

and absgrad is sum |v Q d|, the only one that needs a pass of its own. In the code d_y stands for dL/dy. `tiles.py` says
what is computed together.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from .. import Projection
from .tiles import (
    LN_2,
    MAX_ALPHA,
    SLAB,
    Batch,
    Canvas,
    LocalSplats,
    TileLists,
    expand_around_centres,
    find_footprints,
    group_by_count,
    list_tiles,
    pairs_of,
    split_into_blocks,
)

MIN_TRANSMITTANCE = 1e-4  # a pixel ends before T falls to this
BLOCK_PAIRS = 2**21  # (tile, splat) pairs listed at a time; about 200 bytes each, forward and backward


@contextmanager
def full_precision() -> Iterator[None]:
    """Keep matrix products in the precision of their operands, under autocast and any matmul precision.

    log-alpha reaches tens and is then exponentiated: bfloat16 would be wrong by whole factors. The matmul precision
    reaches CPU products through oneDNN.
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

    alphas: tuple[Tensor, ...]  # alpha_k, 0 where splat k is not drawn, except in pixels ended before. n of [B, P] each
    weights: Tensor  # w_k = alpha_k T_{k-1}. [B, n, P]
    last: Tensor  # T behind the slab, 0 in pixels that have ended. [B, P]
    ends: Tensor | None  # pixels that end in this slab, if any. [B, P]
    capped: tuple[Tensor, Tensor] | None  # rows (of B * n) that can exceed 0.999, and their pixels that do, if any


def _blend(canvas: Canvas, splats: LocalSplats, start: Tensor) -> _Blend:
    """The forward equations of the module docstring for one batch, from T in front of it [B, P].

    Arithmetic with zeros stands in for masks: filling by a mask costs as much as the exponential.
    """
    n_tiles, n = splats.colors.shape[:2]
    pixels = start.shape[1]
    alpha, alphas = canvas.scratch.array("alpha", n_tiles, n, pixels)
    flat = alpha.view(-1, pixels)
    torch.mm(splats.coefficients.t(), canvas.basis, out=flat).exp2_()
    F.threshold_(flat, canvas.too_faint, 0.0)
    capped = None
    if splats.strong.numel() > 0:
        strong = flat.index_select(0, splats.strong)
        exceeds = strong > MAX_ALPHA
        if exceeds.any():
            capped = splats.strong, exceeds
            flat.index_copy_(0, splats.strong, strong.clamp_(max=MAX_ALPHA))

    T, T_slices = canvas.scratch.array("T or U", n_tiles, n + 1, pixels)  # T_0 ... T_n, as if no pixel ended
    T_slices[0].copy_(start)
    for in_front, alpha_k, behind in zip(T_slices, alphas, T_slices[1:], strict=False):
        torch.addcmul(in_front, alpha_k, in_front, value=-1, out=behind)  # T_k = T_{k-1} - alpha_k T_{k-1}

    last = F.threshold(T_slices[-1], MIN_TRANSMITTANCE, 0.0)
    ends = (last == 0) & (start > 0)
    some_end = bool(ends.any())
    if some_end:
        drawn = torch.gt(T[:, 1:], MIN_TRANSMITTANCE, out=canvas.scratch.array("spare", n_tiles, n, pixels)[0])
        alpha *= drawn
    weights = torch.mul(alpha, T[:, :-1], out=canvas.scratch.array("weights", n_tiles, n, pixels)[0])
    return _Blend(alphas, weights, last, ends if some_end else None, capped)


def _sweep(canvas: Canvas, lists: TileLists, final: Tensor, render: Tensor | None) -> list[Batch]:
    """Composite one block front to back; return its batches in the order of work, for the backward pass.

    Args:
        final: transmittance behind the last drawn splat, set for the tiles that have splats. [C * tiles, P]
        render: colours, added in place; None repeats a sweep for its batches only. [C * tiles, D, P]
    """
    record = []
    live = canvas.inside.index_select(0, lists.tiles)  # T, or 0 in finished pixels. [L, P]
    ended = torch.zeros_like(live)  # T where a pixel ended, or 0 in live pixels
    centres = canvas.centres(lists.tiles)
    active = torch.arange(lists.tiles.numel())
    first = 0
    while active.numel() > 0:
        remaining = (lists.count.index_select(0, active) - first).clamp(max=SLAB)
        remaining, by_count = torch.sort(remaining, descending=True)
        active = active.index_select(0, by_count)
        for tiles, n in group_by_count(remaining, active, live.shape[1]):
            pairs = pairs_of(lists, tiles, first, n)
            splats = expand_around_centres(canvas, lists, centres.index_select(1, tiles), pairs)
            batch = Batch(tiles, pairs, splats, live.index_select(0, tiles))
            record.append(batch)
            blend = _blend(canvas, splats, batch.transmittance)
            live.index_copy_(0, tiles, blend.last)
            if blend.ends is not None:
                final_T = batch.transmittance - blend.weights.sum(1)  # T_n = T_0 - sum of w_k
                ended.index_add_(0, tiles, final_T.mul_(blend.ends))
            if render is not None:
                on_canvas = lists.tiles.index_select(0, tiles)
                nearer_slabs = render.index_select(0, on_canvas)
                render.index_copy_(0, on_canvas, nearer_slabs.baddbmm_(splats.colors.transpose(1, 2), blend.weights))
        first += SLAB
        unfinished = (lists.count.index_select(0, active) > first) & (live.index_select(0, active).amax(1) > 0)
        active = active[unfinished]
    final.index_copy_(0, lists.tiles, live + ended)
    return record


def _backward_batch(
    canvas: Canvas, batch: Batch, d_render: Tensor, behind: Tensor, absgrad: bool, gradients: Tensor
) -> Tensor:
    """The backward equations of the module docstring for one batch; returns U in front of the first splat, [B, P].

    Args:
        d_render: dL/dC of its tiles. [B, D, P]
        behind: U_n, behind the last splat. [B, P]
        gradients: receives those of centre x, y, conic a, b, c, ln o, colours, then absgrad. [B * n, 6 + D (+ 2)]
    """
    splats, start = batch.splats, batch.transmittance
    blend = _blend(canvas, splats, start)
    n_tiles, n, pixels = blend.weights.shape
    e, e_slices = canvas.scratch.array("spare", n_tiles, n, pixels)
    torch.bmm(splats.colors, d_render, out=e)
    U, U_slices = canvas.scratch.array("T or U", n_tiles, n + 1, pixels)  # U_0 ... U_n
    U_slices[-1].copy_(behind)
    for k in range(n - 1, -1, -1):
        torch.lerp(U_slices[k + 1], e_slices[k], blend.alphas[k], out=U_slices[k])
    in_front = torch.where(start > 0, U_slices[0], behind)
    v = e.sub_(U[:, 1:]).mul_(blend.weights).view(-1, pixels)  # dL/dl
    if blend.capped is not None:
        strong, exceeds = blend.capped
        v[strong] *= ~exceeds

    channels = splats.colors.shape[-1]
    v0, vx, vy, vxx, vxy, vyy = canvas.basis @ v.t()  # sums of v, v x, v y, v x^2 / 2, v xy, v y^2 / 2
    mx, my = splats.centres
    _, gx, gy, a, b, c = splats.coefficients  # here a, b, c are the conic's with a minus
    half_x, half_y = torch.addcmul(vx, mx, v0, value=-0.5), torch.addcmul(vy, my, v0, value=-0.5)
    d_mx, d_my, d_a, d_b, d_c, d_log_opacity = gradients[:, :6].t()
    torch.mul(gx, v0, out=d_mx).addcmul_(a, vx).addcmul_(b, vy)
    torch.mul(gy, v0, out=d_my).addcmul_(b, vx).addcmul_(c, vy)
    torch.mul(mx, half_x, out=d_a).sub_(vxx)
    torch.mul(mx, half_y, out=d_b).addcmul_(my, half_x).sub_(vxy)
    torch.mul(my, half_y, out=d_c).sub_(vyy)
    d_log_opacity.copy_(v0)
    d_colors = torch.bmm(d_render, blend.weights.transpose(1, 2))  # [B, D, n]
    gradients[:, 6 : 6 + channels].view(n_tiles, n, channels).copy_(d_colors.transpose(1, 2))
    if absgrad:
        size = v.abs_()
        for axis, coefficients in enumerate(([gx, a, b], [gy, b, c])):  # -Q d is linear in the pixel: in (1, x, y)
            minus_Q_d = canvas.scratch.array("T or U", n_tiles, n, pixels)[0].view(-1, pixels)
            torch.mm(torch.stack(coefficients).t(), canvas.basis[:3], out=minus_Q_d)
            torch.sum(minus_Q_d.abs_().mul_(size), -1, out=gradients[:, 6 + channels + axis])
    return in_front


def _backward_block(
    canvas: Canvas, lists: TileLists, work: list[Batch], d_render: Tensor, behind: Tensor, absgrad: bool, n_columns: int
) -> Tensor:
    """Gradients of one block by its footprints, in the columns of `_backward_batch`. [F, columns]

    Args:
        work: the batches of its `_sweep`.
        d_render: dL/dC. [C * tiles, D, P]
        behind: U behind the last splat; afterwards U in front of the first one. [C * tiles, P]
    """
    # Gradients in the order of work, and the row of each slot; pairs beyond all batches share a row of 0.
    end = sum(batch.pairs.numel() for batch in work)
    gradients = d_render.new_empty(end + 1, n_columns)
    gradients[end] = 0
    row_of_slot = torch.full((lists.n_pairs + 1,), end)
    for batch in reversed(work):
        on_canvas = lists.tiles.index_select(0, batch.tiles)
        begin = end - batch.pairs.numel()
        grads = d_render.index_select(0, on_canvas), behind.index_select(0, on_canvas)
        in_front = _backward_batch(canvas, batch, *grads, absgrad, gradients[begin:end])
        behind.index_copy_(0, on_canvas, in_front)
        slots = lists.slot.index_select(0, batch.pairs.flatten())
        row_of_slot.index_copy_(0, slots, torch.arange(begin, end))
        end = begin
    # Pairs of a splat lie in consecutive slots: one segmented sum, many times faster than a scatter.
    return F.embedding_bag(row_of_slot[:-1], gradients, lists.splat_start, mode="sum")


def composite(
    projection: Projection, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, absgrad: bool
) -> tuple[Tensor, Tensor, dict]:
    """Render [C, H, W, D] over backgrounds [C, D], alphas [C, H, W, 1], and no lists to add to `info`."""
    tables = projection.means2d, projection.conics, opacities, colors
    render, transmittance = CompositeSplats.apply(*tables, projection, absgrad)
    if backgrounds is not None:
        render = render + transmittance * backgrounds[:, None, None, :]
    return render, 1 - transmittance, {}


class CompositeSplats(torch.autograd.Function):
    """(means2d, conics, opacities, colors) -> (render [C, H, W, D], transmittance [C, H, W, 1])."""

    @staticmethod
    @full_precision()
    def forward(ctx, means2d, conics, opacities, colors, projection: Projection, absgrad: bool):
        footprints = find_footprints(projection, opacities)
        blocks = split_into_blocks(footprints, BLOCK_PAIRS)
        size = (projection.n_cameras, projection.width, projection.height)
        canvas = Canvas(footprints, colors.index_select(0, footprints.rows), *size)
        final = torch.ones_like(canvas.inside)
        render = final.new_zeros(canvas.n_tiles, colors.shape[1], final.shape[1])
        records = []
        for block in blocks:
            lists = list_tiles(footprints, block)
            work = _sweep(canvas, lists, final, render)
            # Records of several blocks would undo the bound on memory: the blocks are swept again instead.
            records.append((lists, work) if len(blocks) == 1 else None)
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.canvas, ctx.blocks, ctx.records, ctx.absgrad = canvas, blocks, records, absgrad
        return canvas.image(render, *size), canvas.image(final[:, None], *size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    @full_precision()
    def backward(ctx, d_render: Tensor, d_transmittance: Tensor):
        means2d, conics, opacities, colors = ctx.saved_tensors
        canvas = ctx.canvas
        d_render = canvas.tiled(d_render)
        behind = canvas.tiled(d_transmittance).squeeze(1).clone()  # U_n
        channels = colors.shape[1]
        n_columns = 6 + channels + (2 if ctx.absgrad else 0)
        drawn = d_render.new_zeros(canvas.footprints.rows.numel(), n_columns)
        for block, record in zip(ctx.blocks, ctx.records, strict=True):
            if record is None:
                lists = list_tiles(canvas.footprints, block)
                record = lists, _sweep(canvas, lists, torch.empty_like(canvas.inside), None)
            drawn += _backward_block(canvas, *record, d_render, behind, ctx.absgrad, n_columns)
        drawn[:, :2] *= -LN_2  # the coefficients are those of l / ln 2
        drawn[:, 6 + channels :] *= LN_2
        total = d_render.new_zeros(means2d.shape[0], n_columns).index_copy_(0, canvas.footprints.rows, drawn)
        if ctx.absgrad:
            means2d.absgrad = total[:, -2:].contiguous()
        d_opacities = total[:, 5] / opacities.where(opacities > 0, 1.0)
        d_colors = total[:, 6 : 6 + channels]
        return total[:, :2].contiguous(), total[:, 2:5].contiguous(), d_opacities, d_colors, None, None
