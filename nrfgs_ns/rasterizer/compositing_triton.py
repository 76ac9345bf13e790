# SPDX-License-Identifier: Apache-2.0
"""gsplat's compositing and its gradients for one image of three channels, in two Triton kernels; gsplat is the oracle.

gsplat's threads are pixels: what they add to a splat's gradient is summed over a warp by shuffles, nine numbers for
each splat. Here threads are splats, as in the backward pass of Mallick et al., Taming 3DGS (2024). A program, of one
warp, has a tile and goes through the tile's list in batches of LANES x EACH splats. A thread has EACH of them, and sums
over its columns of the tile in registers. In return, the light that is left is a scan over the lanes.

Splat k covers a pixel with alpha_k = min(0.999, o_k exp(-sigma_k)), counted as 0 below 1/255 or where sigma_k < 0. The
light behind it is T_k = T_{k-1} (1 - alpha_k), T_0 = 1. The first splat that would bring T_k to 1e-4 or below ends the
pixel, and is not drawn itself: since T_k falls, those are drawn that leave T_k > 1e-4. Of n drawn splats

    C = sum_k w_k c_k + T_n b,    A = 1 - T_n = sum_k w_k,    w_k = alpha_k T_{k-1},    b the background.

With g = dL/dC, h = dL/dA and s_k = w_k c_k . g, all that lies behind splat k adds R_k to the loss:

    dL/dsigma_k = -w_k (c_k . g - R_k / T_k),
    R_k = sum_{j > k} s_j + T_n (g . b - h) = g . C - h T_n - sum_{j <= k} s_j,

so that the backward pass goes front to back too. As a difference R_k is off by rounding units of sum_j |s_j|, and so
dL/do_k by 1 / (1 - alpha_k) of that, up to a thousand times. gsplat goes back to front from a T_n that has been rounded
as 1 - A: its w_k are off by a rounding unit / T_n of themselves.

Pixels of a column have the same distance dx from a splat's centre, pixels of a row the same dy. So gradients of centres
and conics are sums over columns of three numbers: v = -dL/dsigma, v dy and v dy^2.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = tl.constexpr(8)
"""Side of a tile in pixels."""
LANES = tl.constexpr(8)
"""Threads of a warp along the list; a power of two."""
EACH = tl.constexpr(4)
"""Splats of a thread."""

LOG2_E = tl.constexpr(1.4426950408889634)
LN_2 = tl.constexpr(0.6931471805599453)
MAX_ALPHA = tl.constexpr(0.999)
MIN_ALPHA = tl.constexpr(1.0 / 255.0)
MIN_TRANSMITTANCE = tl.constexpr(1e-4)


@triton.jit
def load_rows(table, rows, valid, SIZE: tl.constexpr):
    """Some rows of a table [.., SIZE], as a tuple of columns; 0 where they are not valid."""
    columns = ()
    for i in tl.static_range(SIZE):
        columns = columns + (tl.load(table + rows * SIZE + i, mask=valid, other=0.0),)
    return columns


@triton.jit
def _add(table, rows, values, SIZE: tl.constexpr):
    """Add values [BLOCK, LANES], summed over columns of pixels, to rows of a table [.., SIZE]."""
    for i in tl.static_range(SIZE):
        total = tl.sum(values[i], axis=0, keep_dims=True)
        tl.atomic_add(table + rows * SIZE + i, total, mask=total != 0.0, sem="relaxed")


@triton.jit
def _lane(values, lane):
    """Values [BLOCK, LANES] of one lane for each."""
    return tl.gather(values, tl.zeros_like(values).to(tl.int32) + lane, 1)


@triton.jit
def _tile():
    """This program's tile; columns [BLOCK, 1] and first row of its pixels."""
    tile = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    return tile, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None], tl.program_id(1) * BLOCK


@triton.jit
def _pixels(row, column, width, height):
    """A row of pixels: their numbers, and which of them the image has."""
    return row * width + column, column < tl.where(row < height, width, 0)


@triton.jit
def _batch(ids, at, end, column, means2d, conics, opacities, colors):
    """A batch of a list, EACH times: splats; dx and a dx [BLOCK, LANES]; b and c; the centre's y; log2 of the opacity;
    colours. a dx^2 + b dx dy + c dy^2 is -log2(e) sigma. [1, LANES]"""
    splats = ()
    for k in tl.static_range(EACH):
        place = at + tl.arange(0, LANES)[None, :] * EACH + k
        valid = place < end
        splat = tl.load(ids + place, mask=valid, other=0)
        x, y = load_rows(means2d, splat, valid, 2)
        a, b, c = load_rows(conics, splat, valid, 3)
        a, b, c = a * (-0.5 * LOG2_E), b * -LOG2_E, c * (-0.5 * LOG2_E)
        dx = x - (column.to(tl.float32) + 0.5)
        opacity = tl.load(opacities + splat, mask=valid, other=0.0)
        peak = tl.where(opacity <= 0.0, -float("inf"), tl.log2(opacity))
        splats += ((splat, dx, a * dx, b, c, y, peak, load_rows(colors, splat, valid, 3)),)
    return splats


@triton.jit
def _blend(splats, row, left):
    """A batch at a row of pixels, with T = `left` in front of it: EACH times o exp(-sigma), alpha (0: not drawn) and w;
    T behind the last splat that a thread draws; T behind the batch. [BLOCK, LANES]

    Sums of products are spelt out, so that both kernels draw the same splats."""
    shown, alphas, passed = (), (), ()
    for k in tl.static_range(EACH):
        _, dx, a_dx, b, c, y, peak, _ = splats[k]
        dy = y - (row.to(tl.float32) + 0.5)
        power = tl.fma(dx, tl.fma(b, dy, a_dx), tl.fma(c * dy, dy, peak))
        value = tl.exp2(power)
        alpha = tl.minimum(value, MAX_ALPHA)
        alpha = tl.where((power > peak) | (alpha < MIN_ALPHA), 0.0, alpha)
        passes = (1.0 - alpha) if k == 0 else passed[k - 1] * (1.0 - alpha)
        shown, alphas, passed = shown + (value,), alphas + (alpha,), passed + (passes,)
    scan = tl.cumprod(passed[EACH - 1], 1)
    lane = tl.arange(0, LANES)[None, :]
    front = left * tl.where(lane == 0, 1.0, _lane(scan, tl.maximum(lane - 1, 0)))
    drawn, weights, before, last = (), (), front, front
    for k in tl.static_range(EACH):
        behind = front * passed[k]
        alpha = tl.where(behind > MIN_TRANSMITTANCE, alphas[k], 0.0)
        drawn, weights = drawn + (alpha,), weights + (alpha * before,)
        last = tl.where(behind > MIN_TRANSMITTANCE, behind, last)
        before = behind
    return shown, drawn, weights, last, left * _lane(scan, LANES - 1)


@triton.jit(do_not_specialize=["width", "height"])
def forward_kernel(
    begins, ids, means2d, conics, opacities, colors, background, render, alphas, ends, width, height
):  # fmt: skip
    """Image [height, width, 3] over a background, A [height, width], and where each program has ended in its list."""
    tile, column, top = _tile()
    none = tl.zeros((BLOCK, LANES), tl.float32)
    rows = ()
    for row in tl.static_range(BLOCK):
        pixel, inside = _pixels(top + row, column, width, height)
        rows += ((tl.where(inside, 1.0, none), none, none, none, none),)
    at, end, live = tl.load(begins + tile), tl.load(begins + tile + 1), 1
    while (at < end) & (live > 0):
        splats = _batch(ids, at, end, column, means2d, conics, opacities, colors)
        new_rows, most_left = (), none
        for row in tl.static_range(BLOCK):
            left, red, green, blue, covered = rows[row]
            _, _, weights, _, left = _blend(splats, top + row, left)
            for k in tl.static_range(EACH):
                color = splats[k][7]
                red, green = tl.fma(weights[k], color[0], red), tl.fma(weights[k], color[1], green)
                blue, covered = tl.fma(weights[k], color[2], blue), covered + weights[k]
            new_rows, most_left = new_rows + ((left, red, green, blue, covered),), tl.maximum(most_left, left)
        rows = new_rows
        at += LANES * EACH
        # As an integer, of the whole warp: one instruction, after which the compiler knows that threads stay together.
        live = tl.max((most_left > MIN_TRANSMITTANCE).to(tl.int32))
    tl.store(ends + tile, tl.minimum(at, end))
    for row in tl.static_range(BLOCK):
        pixel, inside = _pixels(top + row, column, width, height)
        alpha = tl.sum(rows[row][4], axis=1, keep_dims=True)
        tl.store(alphas + pixel, alpha, mask=inside)
        for i in tl.static_range(3):
            color = tl.sum(rows[row][1 + i], axis=1, keep_dims=True)
            tl.store(render + pixel * 3 + i, tl.fma(1.0 - alpha, tl.load(background + i), color), mask=inside)


@triton.jit(do_not_specialize=["width", "height"])
def backward_kernel(
    begins, ids, means2d, conics, opacities, colors, render, alphas, ends, d_render, d_alphas,
    d_means2d, d_conics, d_opacities, d_colors, absgrad, width, height, ABSGRAD: tl.constexpr,
):  # fmt: skip
    """Add the gradients of the forward pass's tables to tables of zeros, from its results and their gradients."""
    tile, column, top = _tile()
    none = tl.zeros((BLOCK, LANES), tl.float32)
    left, worth = (), ()  # T and R of the block's rows, the next one's first
    for step in tl.static_range(BLOCK):
        pixel, inside = _pixels(top + step, column, width, height)
        upstream, rgb = load_rows(d_render, pixel, inside, 3), load_rows(render, pixel, inside, 3)
        value = tl.load(alphas + pixel, mask=inside, other=0.0) - 1.0
        value *= tl.load(d_alphas + pixel, mask=inside, other=0.0)
        for i in tl.static_range(3):
            value = tl.fma(upstream[i], rgb[i], value)
        left, worth = left + (tl.where(inside, 1.0, none),), worth + (value + none,)
    end = tl.load(begins + tile + 1)
    for at in range(tl.load(begins + tile), tl.load(ends + tile), LANES * EACH):
        splats = _batch(ids, at, end, column, means2d, conics, opacities, colors)
        sums = ()
        for _k in tl.static_range(EACH):
            sums += ((none, none, none, none, none, none, none, none),)
        for row in range(BLOCK):
            pixel, inside = _pixels(top + row, column, width, height)
            red, green, blue = load_rows(d_render, pixel, inside, 3)
            shown, drawn, weights, last, new_left = _blend(splats, top + row, left[0])
            gains, total = (), none
            for k in tl.static_range(EACH):
                color = splats[k][7]
                gains += (tl.fma(red, color[0], tl.fma(green, color[1], blue * color[2])),)
                total = tl.fma(weights[k], gains[k], total)
            scan = tl.cumsum(total, 1)
            mean = (worth[0] - scan) / tl.maximum(last, MIN_TRANSMITTANCE)  # R_k / T_k of a thread's last splat
            left, worth = left[1:] + (new_left,), worth[1:] + (worth[0] - _lane(scan, LANES - 1),)
            new_sums = ()
            for k in tl.static_range(EACH - 1, -1, -1):
                _, dx, a_dx, b, c, y, _, _ = splats[k]
                v0, vy, vyy, d_red, d_green, d_blue, abs_x, abs_y = sums[k]
                more = gains[k] - mean
                mean = tl.fma(drawn[k], more, mean)
                v = tl.where(shown[k] <= MAX_ALPHA, weights[k] * more, 0.0)
                dy = y - ((top + row).to(tl.float32) + 0.5)
                v0, vy, vyy = v0 + v, tl.fma(v, dy, vy), tl.fma(v, dy * dy, vyy)
                d_red, d_green = tl.fma(weights[k], red, d_red), tl.fma(weights[k], green, d_green)
                d_blue = tl.fma(weights[k], blue, d_blue)
                if ABSGRAD:
                    abs_x = tl.fma(tl.abs(v), tl.abs(tl.fma(2.0, a_dx, b * dy)), abs_x)
                    abs_y = tl.fma(tl.abs(v), tl.abs(tl.fma(b, dx, 2.0 * c * dy)), abs_y)
                new_sums = ((v0, vy, vyy, d_red, d_green, d_blue, abs_x, abs_y),) + new_sums
            sums = new_sums
        for k in tl.static_range(EACH):
            splat, dx, a_dx, b, c, _, _, _ = splats[k]
            v0, vy, vyy, d_red, d_green, d_blue, abs_x, abs_y = sums[k]
            vx = v0 * dx
            _add(d_colors, splat, (d_red, d_green, d_blue), 3)
            _add(d_opacities, splat, (v0 * (1.0 / tl.maximum(tl.load(opacities + splat), MIN_ALPHA)),), 1)
            _add(d_means2d, splat, ((2.0 * v0 * a_dx + b * vy) * LN_2, (b * vx + 2.0 * c * vy) * LN_2), 2)
            _add(d_conics, splat, (-0.5 * vx * dx, -vy * dx, -0.5 * vyy), 3)
            if ABSGRAD:
                _add(absgrad, splat, (abs_x * LN_2, abs_y * LN_2), 2)


class CompositeSplats(torch.autograd.Function):
    """(means2d, conics, opacities, colors, background [1, 3]) -> (render [1, H, W, 3], alphas [1, H, W, 1]).

    All tensors are contiguous; `begins` and `ids` are `tile_lists`'s for tiles of BLOCK pixels, `shape` is width and
    height. With `absgrad` the backward pass leaves sum |dL/dmean2d| over pixels in `means2d.absgrad`.
    """

    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, background, begins, ids, shape: tuple, absgrad: bool):
        width, height = ctx.shape = shape
        ctx.absgrad, ctx.grid = absgrad, (begins.shape[2], begins.shape[1] - 1)
        render, alphas = means2d.new_empty(1, height, width, 3), means2d.new_empty(1, height, width, 1)
        tables = begins, ids, means2d, conics, opacities, colors
        results = render, alphas, ids.new_empty(ctx.grid[0] * ctx.grid[1])
        forward_kernel[ctx.grid](*tables, background, *results, *shape, num_warps=1)
        ctx.save_for_backward(*tables, *results)
        return render, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, d_render: Tensor, d_alphas: Tensor):
        _, _, *tables, _, alphas, _ = saved = ctx.saved_tensors
        gradients = [torch.zeros_like(table) for table in tables]
        absgrad = torch.zeros_like(tables[0]) if ctx.absgrad else alphas
        arguments = *saved, d_render.contiguous(), d_alphas.contiguous(), *gradients, absgrad, *ctx.shape
        backward_kernel[ctx.grid](*arguments, ABSGRAD=ctx.absgrad, num_warps=1)
        if ctx.absgrad:
            tables[0].absgrad = absgrad
        background = ((1.0 - alphas) * d_render).sum((1, 2)) if ctx.needs_input_grad[4] else None
        return *gradients, background, None, None, None, None
