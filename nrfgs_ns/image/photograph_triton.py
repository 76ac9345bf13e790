# SPDX-License-Identifier: Apache-2.0
"""What a photograph's exposure and white balance make of a picture, in Triton: one kernel forward, two backward.

An image [H, W, 3] is a row of numbers, number n of channel n mod 3. With k_c = 2^(sum_r exponents[c, r] shot[r]),

    y = clamp(k_c x + toe (k_c - 1), 0, 1)      dx = k_c dy      dk_c = sum of (x + toe) dy, where y is within bounds

No atomics: each program writes its own partial sums, so the result is the same every time. The second backward kernel
adds them up and writes the gradient of all photographs' numbers, zero except for this one's.
"""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.image.photograph import TOE as SRGB_TOE
from nrfgs_ns.kernels.launch import Launcher

BLOCK = 4096
"""Numbers of an image that a program takes; a power of two."""
SUMS = 1024
"""Partial sums, and numbers of photographs, that the last kernel takes at once; a power of two."""
WARPS = 8
TOE = tl.constexpr(SRGB_TOE)
LOG_2 = tl.constexpr(math.log(2.0))


@triton.jit
def _gain(shot, exponents, channel: tl.constexpr, ROWS: tl.constexpr):
    """2^(stops / gamma) of one channel."""
    power = 0.0
    for row in tl.static_range(ROWS):
        power += tl.load(shot + row) * tl.load(exponents + channel * ROWS + row)
    return tl.exp2(power)


@triton.jit
def _of_channel(channel, red, green, blue):
    return tl.where(channel == 0, red, tl.where(channel == 1, green, blue))


@triton.jit(do_not_specialize=["numbers", "index"])
def forward_kernel(
    image, taken, shots, exponents, numbers, index, BLOCK: tl.constexpr, ROWS: tl.constexpr
):  # fmt: skip
    """The picture as taken."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < numbers
    shot = shots + index * ROWS
    red, green, blue = _gain(shot, exponents, 0, ROWS), _gain(shot, exponents, 1, ROWS), _gain(shot, exponents, 2, ROWS)
    gain = _of_channel(at % 3, red, green, blue)
    x = tl.load(image + at, mask=here, other=0.0)
    y = x * gain + (gain * TOE - TOE)
    y = tl.where(y < 0.0, 0.0, tl.where(y > 1.0, 1.0, y))  # not a number stays that
    tl.store(taken + at, y, mask=here)


@triton.jit(do_not_specialize=["numbers", "index"])
def backward_kernel(
    image, d_taken, d_image, partials, shots, exponents, numbers, index, BLOCK: tl.constexpr, ROWS: tl.constexpr
):  # fmt: skip
    """Gradient of the image, and partial sums [programs, 3] of the gains'."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here, channel = at < numbers, at % 3
    shot = shots + index * ROWS
    red, green, blue = _gain(shot, exponents, 0, ROWS), _gain(shot, exponents, 1, ROWS), _gain(shot, exponents, 2, ROWS)
    gain = _of_channel(channel, red, green, blue)
    x = tl.load(image + at, mask=here, other=0.0)
    y = x * gain + (gain * TOE - TOE)
    d_y = tl.load(d_taken + at, mask=here, other=0.0)
    d_y = tl.where((y < 0.0) | (y > 1.0), 0.0, d_y)
    tl.store(d_image + at, d_y * gain, mask=here)
    d_gain = d_y * (x + TOE)
    mine = partials + tl.program_id(0) * 3
    tl.store(mine, tl.sum(tl.where(channel == 0, d_gain, 0.0), axis=0))
    tl.store(mine + 1, tl.sum(tl.where(channel == 1, d_gain, 0.0), axis=0))
    tl.store(mine + 2, tl.sum(tl.where(channel == 2, d_gain, 0.0), axis=0))


@triton.jit(do_not_specialize=["programs", "total", "index"])
def finish_kernel(
    partials, d_shots, shots, exponents, programs, total, index, BLOCK: tl.constexpr, ROWS: tl.constexpr
):  # fmt: skip
    """Gradient of all photographs' numbers [total], from the gains' partial sums. One program."""
    at = tl.arange(0, BLOCK)
    red, green, blue = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for first in range(0, programs, BLOCK):
        there = first + at < programs
        row = partials + (first + at) * 3
        red += tl.load(row, mask=there, other=0.0)
        green += tl.load(row + 1, mask=there, other=0.0)
        blue += tl.load(row + 2, mask=there, other=0.0)
    shot = shots + index * ROWS
    of_red = tl.sum(red, axis=0) * _gain(shot, exponents, 0, ROWS) * LOG_2
    of_green = tl.sum(green, axis=0) * _gain(shot, exponents, 1, ROWS) * LOG_2
    of_blue = tl.sum(blue, axis=0) * _gain(shot, exponents, 2, ROWS) * LOG_2
    for first in range(0, total, BLOCK):
        number = first + at
        value = tl.zeros((BLOCK,), tl.float32)
        for row in tl.static_range(ROWS):
            own = of_red * tl.load(exponents + row)
            own += of_green * tl.load(exponents + ROWS + row)
            own += of_blue * tl.load(exponents + 2 * ROWS + row)
            value = tl.where(number == index * ROWS + row, own, value)
        tl.store(d_shots + number, value, mask=number < total)


launch_forward, launch_backward = Launcher(forward_kernel), Launcher(backward_kernel)
launch_finish = Launcher(finish_kernel)


class Exposed(torch.autograd.Function):
    """A picture [H, W, 3] as photograph `index` has it, in [0, 1]; float32.

    shots are the photographs' numbers [P, R]; exponents [3, R] say what each makes of the log2 of the channels' gains.
    """

    @staticmethod
    def forward(ctx, image: Tensor, shots: Tensor, index: int, exponents: Tensor) -> Tensor:
        image, shots = image.detach().contiguous(), shots.detach()
        taken = torch.empty_like(image)
        numbers = image.numel()
        ctx.grid = (-(-numbers // BLOCK), 1, 1)
        launch_forward(
            ctx.grid, image, taken, shots, exponents, numbers, index,
            BLOCK=BLOCK, ROWS=shots.shape[1], num_warps=WARPS,
        )  # fmt: skip
        ctx.save_for_backward(image, shots, exponents)
        ctx.index = index
        return taken

    @staticmethod
    @once_differentiable
    def backward(ctx, d_taken: Tensor):
        image, shots, exponents = ctx.saved_tensors
        d_image, d_shots = torch.empty_like(image), torch.empty_like(shots)
        programs, rows = ctx.grid[0], shots.shape[1]
        partials = image.new_empty(3 * programs)
        launch_backward(
            ctx.grid, image, d_taken.contiguous(), d_image, partials, shots, exponents, image.numel(), ctx.index,
            BLOCK=BLOCK, ROWS=rows, num_warps=WARPS,
        )  # fmt: skip
        launch_finish(
            (1, 1, 1), partials, d_shots, shots, exponents, programs, shots.numel(), ctx.index,
            BLOCK=SUMS, ROWS=rows, num_warps=4,
        )  # fmt: skip
        return d_image, d_shots, None, None
