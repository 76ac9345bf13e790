# SPDX-License-Identifier: Apache-2.0
"""Splatfacto's loss in two Triton kernels, one forward and one backward. Equations: `ssim.py`.

An image [H, W, 3] is H rows of 3 W numbers; the neighbour in the same channel is 3 numbers away. A program takes a
block of columns and walks down some rows. It blurs each row, and adds the result to the 11 windows that are open there,
of which the oldest closes. Only the windows' sums are carried from row to row, so the moments never reach memory.
Windows are named after their centre; those that reach out of the image count as zero.

No atomics: each program writes its own partial sum, so the result is the same every time.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.image import metrics

COLUMNS = 128
"""Numbers of a row that a program takes; a power of two."""
ROWS = 16
"""Rows of a program. It reads ten more: fewer rows waste more, more rows leave multiprocessors idle."""
WARPS = 4
"""Warps of a program."""

CHANNELS = tl.constexpr(3)
SIZE = tl.constexpr(metrics.WINDOW_SIZE)
REACH = tl.constexpr(metrics.REACH)
C1 = tl.constexpr(metrics.SSIM_C1)
C2 = tl.constexpr(metrics.SSIM_C2)
# The window is symmetric: W0 is the weight of its ends, W5 of its centre.
W0, W1, W2, W3, W4, W5 = (tl.constexpr(weight) for weight in metrics.WEIGHTS[:6])


@triton.jit
def _taps(row, columns, width):
    """The 11 numbers under the window along a row, a tuple of tiles; zero beyond columns 0..width - 1."""
    taps = ()
    for tap in tl.static_range(SIZE):
        shift = CHANNELS * (tap - REACH)
        inside = (columns >= -shift) & (columns < width - shift)
        taps = taps + (tl.load(row + columns + shift, mask=inside, other=0.0),)
    return taps


@triton.jit
def _blur(t):
    """Weighted mean of 11 tiles."""
    ends = (t[0] + t[10]) * W0 + (t[1] + t[9]) * W1 + (t[2] + t[8]) * W2
    return ends + (t[3] + t[7]) * W3 + (t[4] + t[6]) * W4 + t[5] * W5


@triton.jit
def _blur_products(s, t):
    """Weighted mean of the products of 11 tiles with 11 others."""
    ends = (s[0] * t[0] + s[10] * t[10]) * W0 + (s[1] * t[1] + s[9] * t[9]) * W1 + (s[2] * t[2] + s[8] * t[8]) * W2
    inner = (s[3] * t[3] + s[7] * t[7]) * W3 + (s[4] * t[4] + s[6] * t[6]) * W4
    return ends + inner + s[5] * t[5] * W5


@triton.jit
def _no_windows(COLUMNS: tl.constexpr):
    """Ten empty windows."""
    return (tl.zeros((COLUMNS,), tl.float32),) * 10


@triton.jit
def _next_row(windows, row):
    """Add a blurred row to the ten open windows, oldest first, and to a new one.

    Returns the complete sum of the oldest, and the ten that stay open.
    """
    weights = (W0, W1, W2, W3, W4, W5, W4, W3, W2, W1)
    still_open = ()
    for i in tl.static_range(1, SIZE - 1):
        still_open = still_open + (windows[i] + row * weights[i],)
    return windows[0] + row * W0, still_open + (row * W0,)


@triton.jit(do_not_specialize=["height", "width"])
def forward_kernel(
    prediction, truth, slopes, partials,
    height, width, l1_scale, ssim_scale, constant,
    COLUMNS: tl.constexpr, ROWS: tl.constexpr, SLOPES: tl.constexpr,
):  # fmt: skip
    """Partial sums of the loss, and the slopes [3, height, width] of S by E[x], E[xx], E[xy]; width = 3 W."""
    columns = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * ROWS
    whole = (columns >= REACH * CHANNELS) & (columns < width - REACH * CHANNELS)

    of_x, of_y = _no_windows(COLUMNS), _no_windows(COLUMNS)
    of_xx, of_yy, of_xy = _no_windows(COLUMNS), _no_windows(COLUMNS), _no_windows(COLUMNS)
    l1_sum, ssim_sum = tl.zeros((COLUMNS,), tl.float32), tl.zeros((COLUMNS,), tl.float32)
    for step in range(ROWS + SIZE - 1):
        row = first - REACH + step
        row_width = tl.where((row >= 0) & (row < height), width, 0)  # nothing above and below the image
        x_taps = _taps(prediction + row * width, columns, row_width)
        y_taps = _taps(truth + row * width, columns, row_width)
        x, of_x = _next_row(of_x, _blur(x_taps))
        y, of_y = _next_row(of_y, _blur(y_taps))
        xx, of_xx = _next_row(of_xx, _blur_products(x_taps, x_taps))
        yy, of_yy = _next_row(of_yy, _blur_products(y_taps, y_taps))
        xy, of_xy = _next_row(of_xy, _blur_products(x_taps, y_taps))
        centre = row - REACH
        if centre >= first:
            here = columns < tl.where(centre < height, width, 0)
            at = centre * width + columns
            error = tl.load(prediction + at, mask=here, other=0.0) - tl.load(truth + at, mask=here, other=0.0)
            l1_sum += tl.abs(error)

            inside = whole & (centre >= REACH) & (centre < height - REACH)
            product = x * y
            squares = x * x + y * y
            A = product * 2.0 + C1
            B = (xy - product) * 2.0 + C2
            C = squares + C1
            D = xx + yy - squares + C2
            scale = 1.0 / (C * D)
            S = A * B * scale
            ssim_sum += tl.where(inside, S, 0.0)
            if SLOPES:
                slope_xx = -S / D
                slope_xy = A * scale * 2.0
                slope_x = (y * B * scale - x * (S / C + slope_xx)) * 2.0 - y * slope_xy
                plane = height * width
                tl.store(slopes + at, tl.where(inside, slope_x, 0.0), mask=here)
                tl.store(slopes + plane + at, tl.where(inside, slope_xx, 0.0), mask=here)
                tl.store(slopes + 2 * plane + at, tl.where(inside, slope_xy, 0.0), mask=here)

    program = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    mine = tl.sum(l1_sum * l1_scale + ssim_sum * ssim_scale, axis=0)
    tl.store(partials + program, mine + tl.where(program == 0, constant, 0.0))


@triton.jit(do_not_specialize=["height", "width"])
def backward_kernel(
    prediction, truth, slopes, d_loss, d_prediction,
    height, width, l1_scale, ssim_scale,
    COLUMNS: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Gradient of the prediction from the loss's, which is one number, and the slopes."""
    columns = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * ROWS
    plane = height * width
    upstream = tl.load(d_loss)

    of_x, of_xx, of_xy = _no_windows(COLUMNS), _no_windows(COLUMNS), _no_windows(COLUMNS)
    for step in range(ROWS + SIZE - 1):
        row = first - REACH + step
        row_width = tl.where((row >= 0) & (row < height), width, 0)  # nothing above and below the image
        start = slopes + row * width
        slope_x, of_x = _next_row(of_x, _blur(_taps(start, columns, row_width)))
        slope_xx, of_xx = _next_row(of_xx, _blur(_taps(start + plane, columns, row_width)))
        slope_xy, of_xy = _next_row(of_xy, _blur(_taps(start + 2 * plane, columns, row_width)))
        centre = row - REACH
        if centre >= first:
            here = columns < tl.where(centre < height, width, 0)
            at = centre * width + columns
            x = tl.load(prediction + at, mask=here, other=0.0)
            y = tl.load(truth + at, mask=here, other=0.0)
            from_ssim = slope_x + x * slope_xx * 2.0 + y * slope_xy
            from_l1 = tl.where(x > y, 1.0, 0.0) - tl.where(x < y, 1.0, 0.0)
            gradient = (from_ssim * ssim_scale + from_l1 * l1_scale) * upstream
            tl.store(d_prediction + at, gradient, mask=here)


class WeightedSum(torch.autograd.Function):
    """l1_weight mean |prediction - truth| + ssim_weight SSIM + constant, of float32 images [H, W, 3] at least as large
    as the window. A training step is bound by the host: one kernel and one sum forward, one kernel backward."""

    @staticmethod
    def forward(ctx, prediction: Tensor, truth: Tensor, l1_weight: float, ssim_weight: float, constant: float):
        prediction, truth = prediction.detach().contiguous(), truth.contiguous()
        height, width = prediction.shape[0], 3 * prediction.shape[1]
        border = metrics.WINDOW_SIZE - 1
        l1_scale = l1_weight / (height * width)
        ssim_scale = ssim_weight / ((height - border) * (width - 3 * border))
        grid = -(-width // COLUMNS), -(-height // ROWS)
        wanted = ctx.needs_input_grad[0]
        slopes = prediction.new_empty(3 * height * width if wanted else 0)
        partials = prediction.new_empty(grid[0] * grid[1])
        forward_kernel[grid](
            prediction, truth, slopes, partials, height, width, l1_scale, ssim_scale, constant,
            COLUMNS=COLUMNS, ROWS=ROWS, SLOPES=wanted, num_warps=WARPS,
        )  # fmt: skip
        ctx.save_for_backward(prediction, truth, slopes)
        ctx.scales, ctx.grid = (l1_scale, ssim_scale), grid
        return partials.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, d_loss: Tensor):
        prediction, truth, slopes = ctx.saved_tensors
        height, width = prediction.shape[0], 3 * prediction.shape[1]
        d_prediction = torch.empty_like(prediction)
        backward_kernel[ctx.grid](
            prediction, truth, slopes, d_loss, d_prediction, height, width, *ctx.scales,
            COLUMNS=COLUMNS, ROWS=ROWS, num_warps=WARPS,
        )  # fmt: skip
        return d_prediction, None, None, None, None
