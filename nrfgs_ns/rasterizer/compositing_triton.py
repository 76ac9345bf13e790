# SPDX-License-Identifier: Apache-2.0
r"""gsplat's compositing and its gradients for one image of three channels, in two Triton kernels.

gsplat's threads are pixels: what a pixel does to a splat's gradient is summed over a warp by shuffles, nine numbers for
each splat. Here threads are splats, as in Mallick et al., Taming 3DGS (2024): a program composites some rows of a tile,
and goes through the tile's list in batches of LANES x EACH splats. A thread has EACH consecutive splats and some
columns of pixels, whose gradients it sums in registers. In return, what a pixel has passed is a scan over the lanes,
but only of one number for EACH splats.

Splat k covers a pixel with alpha_k = min(0.999, o_k exp(-sigma_k)), counted as 0 below 1/255 or where sigma_k < 0, and
the light behind it is T_k = T_{k-1} (1 - alpha_k), T_0 = 1. The first splat that would bring T_k to 1e-4 or below ends
the pixel, and is not drawn itself: since T_k falls, those are drawn that leave T_k > 1e-4. Then

    C = sum_k w_k c_k + T_n b,    A = 1 - T_n = sum_k w_k,    w_k = alpha_k T_{k-1},    b the background.

With g = dL/dC, h = dL/dA and s_k = w_k c_k . g,

    dL/dsigma_k = -s_k + alpha_k / (1 - alpha_k) R_k,    R_k = sum_{j > k} s_j + T_n (g . b - h) = g . C - h T_n - sum_{j <= k} s_j,

so that the backward pass also goes front to back. R_k is a difference: it is off by some rounding units of sum |s_j|,
and so is dL/dsigma_k, times alpha_k / (1 - alpha_k). gsplat goes back to front, from a T_n that has been rounded as
1 - A, so that its T_k are off by up to 1e-7 / T_n of themselves.

Pixels of a column share dx, their distance from a splat's centre along x, and pixels of a row dy. So gradients of
centres and conics need three sums over a column, of v = dL/dsigma, v dy and v dy^2.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.kernels.launch import Launcher

LANES = 8
"""Threads of a warp along the list; a power of two."""
EACH = 4
"""Splats of a thread."""
ROWS = 8
"""Most rows of pixels of a program."""

PACKED = True
STEP = 1
WARPS = 1
MAXNREG_F = MAXNREG_B = None

LOG2_E = tl.constexpr(1.4426950408889634)
LN_2 = tl.constexpr(0.6931471805599453)
MAX_ALPHA = tl.constexpr(0.999)
MIN_ALPHA = tl.constexpr(1.0 / 255.0)
MIN_TRANSMITTANCE = tl.constexpr(1e-4)


@triton.jit
def _multiply(a, b):
    return a * b


@triton.jit
def _plus(a, b):
    return a + b


@triton.jit
def _batch(ids, at, end, x, means2d, conics, opacities, colors, LANES: tl.constexpr, EACH: tl.constexpr):
    """The splats of a batch: EACH times rows, x's distances [X, LANES], then -log2(e) times the terms of sigma: xx / 2
    at these distances, xy, yy / 2; centre's y, log2 of the opacity, colours."""
    splats = ()
    for k in tl.static_range(EACH):
        place = at + tl.arange(0, LANES) * EACH + k
        valid = place < end
        splat = tl.load(ids + place, mask=valid, other=0)
        dx = tl.load(means2d + splat * 2, mask=valid, other=0.0)[None, :] - x[:, None]
        y = tl.load(means2d + splat * 2 + 1, mask=valid, other=0.0)
        a = tl.load(conics + splat * 3, mask=valid, other=0.0) * (-0.5 * LOG2_E)
        b = tl.load(conics + splat * 3 + 1, mask=valid, other=0.0) * -LOG2_E
        c = tl.load(conics + splat * 3 + 2, mask=valid, other=0.0) * (-0.5 * LOG2_E)
        opacity = tl.load(opacities + splat, mask=valid, other=0.0)
        peak = tl.where(opacity <= 0.0, -float("inf"), tl.log2(opacity))
        red = tl.load(colors + splat * 3, mask=valid, other=0.0)
        green = tl.load(colors + splat * 3 + 1, mask=valid, other=0.0)
        blue = tl.load(colors + splat * 3 + 2, mask=valid, other=0.0)
        splats += ((splat, dx, a[None, :] * dx * dx, a, b, c, y, peak, red, green, blue),)
    return splats


@triton.jit
def _lane(values, lane):
    """Values [X, LANES] of one lane for each."""
    return tl.gather(values, tl.zeros_like(values).to(tl.int32) + lane, 1)


@triton.jit
def _blend(splats, y, start, LANES: tl.constexpr, EACH: tl.constexpr):
    """A batch at a row of pixels that `start` is left for: o exp(-sigma) and alpha of each splat, where 0 stands for
    what is not drawn; T in front of a thread's splats and behind each of them, and T behind the batch. All [X, LANES].

    Sums of products are spelt out, so that both kernels draw the same splats."""
    shown, alphas, passed = (), (), ()
    for k in tl.static_range(EACH):
        _, dx, along_x, _, b, c, center, peak, _, _, _ = splats[k]
        dy = center - y
        power = tl.fma(dx, (b * dy)[None, :], along_x + tl.fma(c * dy, dy, peak)[None, :])
        value = tl.exp2(power)
        alpha = tl.minimum(value, MAX_ALPHA)
        alpha = tl.where((power > peak[None, :]) | (alpha < MIN_ALPHA), 0.0, alpha)
        passes = 1.0 - alpha
        if k > 0:
            passes *= passed[k - 1]
        shown, alphas, passed = shown + (value,), alphas + (alpha,), passed + (passes,)
    scan = tl.associative_scan(passed[EACH - 1], 1, _multiply)
    lane = tl.arange(0, LANES)[None, :]
    front = start * tl.where(lane == 0, 1.0, _lane(scan, tl.maximum(lane - 1, 0)))
    drawn, behind = (), ()
    for k in tl.static_range(EACH):
        left = front * passed[k]
        drawn, behind = drawn + (tl.where(left > MIN_TRANSMITTANCE, alphas[k], 0.0),), behind + (left,)
    return shown, drawn, front, behind, start * _lane(scan, LANES - 1)


@triton.jit(do_not_specialize=["width", "height", "columns"])
def forward_kernel(
    begins, ids, means2d, conics, opacities, colors, background, render, alphas, ends,
    width, height, columns,
    SIDE: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr, EACH: tl.constexpr,
):  # fmt: skip
    """Image [height, width, 3] over a background, alphas [height, width], and how far each program has gone in its
    tile's list."""
    program = tl.program_id(0)
    tile = program // (SIDE // ROWS)
    column = tile % columns * SIDE + tl.arange(0, SIDE)
    top = tile // columns * SIDE + program % (SIDE // ROWS) * ROWS
    x = column.to(tl.float32) + 0.5
    left, red, green, blue, covered = (), (), (), (), ()
    none = tl.zeros((SIDE, LANES), tl.float32)
    for row in tl.static_range(ROWS):
        left += (tl.where(column < tl.where(top + row < height, width, 0), 1.0, 0.0)[:, None] + none,)
        red, green, blue, covered = red + (none,), green + (none,), blue + (none,), covered + (none,)
    at, end, live = tl.load(begins + tile), tl.load(begins + tile + 1), 1
    while (at < end) & (live > 0):
        splats = _batch(ids, at, end, x, means2d, conics, opacities, colors, LANES, EACH)
        new_left, new_red, new_green, new_blue, new_covered = (), (), (), (), ()
        for row in tl.static_range(ROWS):
            y = (top + row).to(tl.float32) + 0.5
            _, drawn, before, behind, last = _blend(splats, y, left[row], LANES, EACH)
            r, g, b, all = red[row], green[row], blue[row], covered[row]
            for k in tl.static_range(EACH):
                weight = drawn[k] * (before if k == 0 else behind[k - 1])
                r = tl.fma(weight, splats[k][8][None, :], r)
                g = tl.fma(weight, splats[k][9][None, :], g)
                b = tl.fma(weight, splats[k][10][None, :], b)
                all += weight
            new_left, new_covered = new_left + (last,), new_covered + (all,)
            new_red, new_green, new_blue = new_red + (r,), new_green + (g,), new_blue + (b,)
        left, red, green, blue, covered = new_left, new_red, new_green, new_blue, new_covered
        at += LANES * EACH
        brightest = left[0]
        for row in tl.static_range(1, ROWS):
            brightest = tl.maximum(brightest, left[row])
        # As an integer, of the whole warp: one instruction, after which the compiler knows that threads stay together.
        live = tl.max((brightest > MIN_TRANSMITTANCE).to(tl.int32))
    tl.store(ends + program, tl.minimum(at, end))
    for row in tl.static_range(ROWS):
        pixel = (top + row) * width + column
        inside = column < tl.where(top + row < height, width, 0)
        alpha = tl.sum(covered[row], axis=1)
        behind = 1.0 - alpha
        tl.store(alphas + pixel, alpha, mask=inside)
        r, g, b = tl.sum(red[row], axis=1), tl.sum(green[row], axis=1), tl.sum(blue[row], axis=1)
        tl.store(render + pixel * 3, tl.fma(behind, tl.load(background), r), mask=inside)
        tl.store(render + pixel * 3 + 1, tl.fma(behind, tl.load(background + 1), g), mask=inside)
        tl.store(render + pixel * 3 + 2, tl.fma(behind, tl.load(background + 2), b), mask=inside)


@triton.jit
def _add(where, some, value):
    tl.atomic_add(where, value, mask=some, sem="relaxed")


@triton.jit
def _add_four(where, some, a, b, c, d):
    """Add to four numbers in a row at once."""
    four = tl.reshape(tl.join(tl.join(a, c), tl.join(b, d)), (a.shape[0], 4))
    tl.atomic_add(where[:, None] + tl.arange(0, 4)[None, :], four, mask=some[:, None], sem="relaxed")


@triton.jit(do_not_specialize=["width", "height", "columns"])
def backward_kernel(
    begins, ids, means2d, conics, opacities, colors, render, alphas, ends, d_render, d_alphas,
    d_means2d, d_conics, d_opacities, d_colors, d_means2d_abs, gradients,
    width, height, columns,
    SIDE: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr, EACH: tl.constexpr, ABSGRAD: tl.constexpr,
    PACKED: tl.constexpr, STEP: tl.constexpr,
):  # fmt: skip
    """Add the gradients of the forward pass's tables to tables of zeros, from its results and their gradients."""
    program = tl.program_id(0)
    tile = program // (SIDE // ROWS)
    column = tile % columns * SIDE + tl.arange(0, SIDE)
    top = tile // columns * SIDE + program % (SIDE // ROWS) * ROWS
    x = column.to(tl.float32) + 0.5
    none = tl.zeros((SIDE, LANES), tl.float32)
    left, worth = (), ()
    for step in tl.static_range(ROWS):
        pixel = (top + step) * width + column
        inside = column < tl.where(top + step < height, width, 0)
        value = tl.load(d_alphas + pixel, mask=inside, other=0.0)
        value *= tl.load(alphas + pixel, mask=inside, other=0.0) - 1.0
        for channel in tl.static_range(3):
            upstream = tl.load(d_render + pixel * 3 + channel, mask=inside, other=0.0)
            value = tl.fma(upstream, tl.load(render + pixel * 3 + channel, mask=inside, other=0.0), value)
        left += (tl.where(inside, 1.0, 0.0)[:, None] + none,)
        worth += (value[:, None] + none,)
    end = tl.load(begins + tile + 1)
    for at in range(tl.load(begins + tile), tl.load(ends + program), LANES * EACH):
        splats = _batch(ids, at, end, x, means2d, conics, opacities, colors, LANES, EACH)
        sums = ()
        for k in tl.static_range(EACH):
            sums += ((none, none, none, none, none, none, none, none),)
        for row in range(0, ROWS, STEP):
            for step in tl.static_range(STEP):
                y = (top + row + step).to(tl.float32) + 0.5
                here = d_render + ((top + row + step) * width + column) * 3
                inside = column < tl.where(top + row + step < height, width, 0)
                red = tl.load(here, mask=inside, other=0.0)[:, None]
                green = tl.load(here + 1, mask=inside, other=0.0)[:, None]
                blue = tl.load(here + 2, mask=inside, other=0.0)[:, None]
                shown, drawn, before, behind, last = _blend(splats, y, left[step], LANES, EACH)
                weights, gains, total, left_over = (), (), none, before
                for k in tl.static_range(EACH):
                    weight = drawn[k] * (before if k == 0 else behind[k - 1])
                    gain = tl.fma(blue, splats[k][10][None, :], green * splats[k][9][None, :])
                    gain = tl.fma(red, splats[k][8][None, :], gain)
                    total = tl.fma(weight, gain, total)
                    left_over = tl.where(behind[k] > MIN_TRANSMITTANCE, behind[k], left_over)
                    weights, gains = weights + (weight,), gains + (gain,)
                scan = tl.associative_scan(total, 1, _plus)
                left, worth = left + (last,), worth + (worth[step] - _lane(scan, LANES - 1),)
                mean = (worth[step] - scan) / tl.maximum(left_over, MIN_TRANSMITTANCE)
                new_sums = ()
                for k in tl.static_range(EACH - 1, -1, -1):
                    _, dx, _, a, b, c, center, _, _, _, _ = splats[k]
                    by_0, by_y, by_yy, by_red, by_green, by_blue, abs_x, abs_y = sums[k]
                    more = gains[k] - mean
                    mean = tl.fma(drawn[k], more, mean)
                    v = tl.where(shown[k] <= MAX_ALPHA, weights[k] * more, 0.0)
                    dy = center - y
                    by_0 += v
                    by_y = tl.fma(v, dy[None, :], by_y)
                    by_yy = tl.fma(v, (dy * dy)[None, :], by_yy)
                    by_red = tl.fma(weights[k], red, by_red)
                    by_green = tl.fma(weights[k], green, by_green)
                    by_blue = tl.fma(weights[k], blue, by_blue)
                    if ABSGRAD:
                        abs_x = tl.fma(tl.abs(v), tl.abs(tl.fma(2.0 * a[None, :], dx, (b * dy)[None, :])), abs_x)
                        abs_y = tl.fma(tl.abs(v), tl.abs(tl.fma(b[None, :], dx, (2.0 * c * dy)[None, :])), abs_y)
                    new_sums = ((by_0, by_y, by_yy, by_red, by_green, by_blue, abs_x, abs_y),) + new_sums
                sums = new_sums
            left, worth = left[STEP:], worth[STEP:]  # the next rows' come first
        for k in tl.static_range(EACH):
            splat, dx, _, a, b, c, _, _, _, _, _ = splats[k]
            by_0, by_y, by_yy, by_red, by_green, by_blue, abs_x, abs_y = sums[k]
            by_x = by_0 * dx
            by_xx, by_xy, by_yy = tl.sum(by_x * dx, axis=0), tl.sum(by_y * dx, axis=0), tl.sum(by_yy, axis=0)
            by_x, by_y, by_0 = tl.sum(by_x, axis=0) * LN_2, tl.sum(by_y, axis=0) * LN_2, tl.sum(by_0, axis=0)
            by_red, by_green, by_blue = tl.sum(by_red, axis=0), tl.sum(by_green, axis=0), tl.sum(by_blue, axis=0)
            some = (by_0 != 0.0) | (by_red != 0.0) | (by_green != 0.0) | (by_blue != 0.0)
            by_0 /= tl.load(opacities + splat, mask=some, other=1.0)
            if ABSGRAD:
                abs_x, abs_y = tl.sum(abs_x, axis=0) * LN_2, tl.sum(abs_y, axis=0) * LN_2
            else:
                abs_x, abs_y = by_0, by_0
            mean_x, mean_y = 2.0 * a * by_x + b * by_y, b * by_x + 2.0 * c * by_y
            if PACKED:
                _add_four(gradients + splat * 12, some, by_red, by_green, by_blue, by_0)
                _add_four(gradients + splat * 12 + 4, some, mean_x, mean_y, abs_x, abs_y)
                _add_four(gradients + splat * 12 + 8, some, -0.5 * by_xx, -by_xy, -0.5 * by_yy, by_0)
            else:
                _add(d_colors + splat * 3, some, by_red)
                _add(d_colors + splat * 3 + 1, some, by_green)
                _add(d_colors + splat * 3 + 2, some, by_blue)
                _add(d_opacities + splat, some, by_0)
                _add(d_means2d + splat * 2, some, mean_x)
                _add(d_means2d + splat * 2 + 1, some, mean_y)
                _add(d_conics + splat * 3, some, -0.5 * by_xx)
                _add(d_conics + splat * 3 + 1, some, -by_xy)
                _add(d_conics + splat * 3 + 2, some, -0.5 * by_yy)
                if ABSGRAD:
                    _add(d_means2d_abs + splat * 2, some, abs_x)
                    _add(d_means2d_abs + splat * 2 + 1, some, abs_y)


launch_forward, launch_backward = Launcher(forward_kernel), Launcher(backward_kernel)


class Composite(torch.autograd.Function):
    """(means2d, conics, opacities, colors) -> (render [1, H, W, 3], alphas [1, H, W, 1]); all tensors contiguous."""

    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, background, begins, ids, sizes: tuple, absgrad: bool):
        tables = begins, ids, means2d, conics, opacities, colors
        render, alphas, ends = composite(*tables, background, *sizes)
        ctx.save_for_backward(*tables, render, alphas, ends)
        ctx.sizes, ctx.absgrad = sizes, absgrad
        return render, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, d_render: Tensor, d_alphas: Tensor):
        upstream = d_render.contiguous(), d_alphas.contiguous()
        *gradients, absolute = gradients_of(*ctx.saved_tensors, *upstream, *ctx.sizes, ctx.absgrad)
        if ctx.absgrad:
            ctx.saved_tensors[2].absgrad = absolute
        return *gradients, None, None, None, None, None


def composite(begins, ids, means2d, conics, opacities, colors, background, width: int, height: int, side: int):
    """Image, alphas, and how far each program has gone in its tile's list."""
    rows, columns = begins.shape[1] - 1, begins.shape[2]
    part = min(ROWS, side)
    grid = (columns * rows * (side // part), 1, 1)
    render, alphas = means2d.new_empty(1, height, width, 3), means2d.new_empty(1, height, width, 1)
    ends = torch.empty(grid[0], dtype=torch.int32, device=means2d.device)
    launch_forward(
        grid, begins, ids, means2d, conics, opacities, colors, background, render, alphas, ends, width, height, columns,
        SIDE=side, ROWS=part, LANES=LANES, EACH=EACH, num_warps=WARPS, maxnreg=MAXNREG_F,
    )  # fmt: skip
    return render, alphas, ends


def gradients_of(
    begins, ids, means2d, conics, opacities, colors, render, alphas, ends, d_render, d_alphas,
    width: int, height: int, side: int, absgrad: bool,
):  # fmt: skip
    """Gradients of means2d, conics, opacities, colors; absgrad or None."""
    packed = means2d.new_zeros(len(means2d), 12) if PACKED else means2d
    gradients = [None if PACKED else torch.zeros_like(table) for table in (means2d, conics, opacities, colors)]
    absolute = torch.zeros_like(means2d) if absgrad and not PACKED else means2d
    launch_backward(
        (len(ends), 1, 1), begins, ids, means2d, conics, opacities, colors, render, alphas, ends, d_render, d_alphas,
        *(means2d if table is None else table for table in gradients), absolute, packed, width, height, begins.shape[2],
        SIDE=side, ROWS=min(ROWS, side), LANES=LANES, EACH=EACH, ABSGRAD=absgrad, PACKED=PACKED, STEP=STEP,
        num_warps=WARPS, maxnreg=MAXNREG_B,
    )  # fmt: skip
    if PACKED:
        gradients = [part.contiguous() for part in (packed[:, 4:6], packed[:, 8:11], packed[:, 3], packed[:, :3])]
        absolute = packed[:, 6:8].contiguous() if absgrad else None
    return *gradients, absolute
