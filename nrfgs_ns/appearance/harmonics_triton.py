# SPDX-License-Identifier: Apache-2.0
"""Spherical harmonics up to degree 3 in Triton: one kernel forward, one backward; PyTorch's twin is `sh_bases`.

gsplat 1.4 launches its own on the legacy stream, which a CUDA graph does not record. The harmonics are polynomials of a
unit direction d = v / |v|; v's gradient is the part of d's that is orthogonal to d, divided by |v|.
"""

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 128
"""Splats that a program takes; a power of two."""
WARPS = 4
SMALLEST = tl.constexpr(1e-12)
"""Shortest length of a direction, as in `torch.nn.functional.normalize`."""
C0 = tl.constexpr(math.sqrt(1 / (4 * math.pi)))
C1 = tl.constexpr(math.sqrt(3 / (4 * math.pi)))
C2 = tl.constexpr(math.sqrt(15 / (4 * math.pi)))
C2Z = tl.constexpr(math.sqrt(5 / (16 * math.pi)))
C3 = tl.constexpr(math.sqrt(35 / (32 * math.pi)))
C3Z = tl.constexpr(math.sqrt(105 / (16 * math.pi)))
C3ZZ = tl.constexpr(math.sqrt(21 / (32 * math.pi)))
C3ZZZ = tl.constexpr(math.sqrt(7 / (16 * math.pi)))


@triton.jit
def _direction(directions, at, valid):
    """Unit directions, and 1 / length."""
    x = tl.load(directions + at * 3, mask=valid, other=1.0)
    y = tl.load(directions + at * 3 + 1, mask=valid, other=0.0)
    z = tl.load(directions + at * 3 + 2, mask=valid, other=0.0)
    inverse = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), SMALLEST)
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _harmonic(index: tl.constexpr, x, y, z):
    """One harmonic at a unit direction, and its slopes by x, y and z."""
    zero = 0.0 * x
    value, slope_x, slope_y, slope_z = zero + C0, zero, zero, zero
    if index == 1:
        value, slope_y = y * -C1, zero - C1
    elif index == 2:
        value, slope_z = z * C1, zero + C1
    elif index == 3:
        value, slope_x = x * -C1, zero - C1
    elif index == 4:
        value, slope_x, slope_y = x * y * C2, y * C2, x * C2
    elif index == 5:
        value, slope_y, slope_z = y * z * -C2, z * -C2, y * -C2
    elif index == 6:
        value, slope_z = (3.0 * z * z - 1.0) * C2Z, 6.0 * z * C2Z
    elif index == 7:
        value, slope_x, slope_z = x * z * -C2, z * -C2, x * -C2
    elif index == 8:
        value, slope_x, slope_y = 0.5 * (x * x - y * y) * C2, x * C2, y * -C2
    elif index == 9:
        value, slope_x, slope_y = y * (y * y - 3.0 * x * x) * C3, -6.0 * x * y * C3, 3.0 * (y * y - x * x) * C3
    elif index == 10:
        value, slope_x = 2.0 * x * y * z * C3Z, 2.0 * y * z * C3Z
        slope_y, slope_z = 2.0 * x * z * C3Z, 2.0 * x * y * C3Z
    elif index == 11:
        value, slope_y, slope_z = y * (1.0 - 5.0 * z * z) * C3ZZ, (1.0 - 5.0 * z * z) * C3ZZ, -10.0 * y * z * C3ZZ
    elif index == 12:
        value, slope_z = z * (5.0 * z * z - 3.0) * C3ZZZ, (15.0 * z * z - 3.0) * C3ZZZ
    elif index == 13:
        value, slope_x, slope_z = x * (1.0 - 5.0 * z * z) * C3ZZ, (1.0 - 5.0 * z * z) * C3ZZ, -10.0 * x * z * C3ZZ
    elif index == 14:
        value, slope_z = z * (x * x - y * y) * C3Z, (x * x - y * y) * C3Z
        slope_x, slope_y = 2.0 * x * z * C3Z, -2.0 * y * z * C3Z
    elif index == 15:
        value, slope_x, slope_y = x * (3.0 * y * y - x * x) * C3, 3.0 * (y * y - x * x) * C3, 6.0 * x * y * C3
    return value, slope_x, slope_y, slope_z


@triton.jit(do_not_specialize=["count"])
def forward_kernel(
    directions, coefficients, colors, count, USED: tl.constexpr, BASES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Sums of the first USED of BASES harmonics."""
    at = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    valid = at < count
    x, y, z, _ = _direction(directions, at, valid)
    red, green, blue = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for index in tl.static_range(USED):
        value, _, _, _ = _harmonic(index, x, y, z)
        own = coefficients + at * (3 * BASES) + 3 * index
        red += value * tl.load(own, mask=valid, other=0.0)
        green += value * tl.load(own + 1, mask=valid, other=0.0)
        blue += value * tl.load(own + 2, mask=valid, other=0.0)
    tl.store(colors + at * 3, red, mask=valid)
    tl.store(colors + at * 3 + 1, green, mask=valid)
    tl.store(colors + at * 3 + 2, blue, mask=valid)


@triton.jit(do_not_specialize=["count"])
def backward_kernel(
    directions, coefficients, d_colors, d_directions, d_coefficients, count,
    USED: tl.constexpr, BASES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of directions and coefficients, those that are not used included."""
    at = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    valid = at < count
    x, y, z, inverse = _direction(directions, at, valid)
    red = tl.load(d_colors + at * 3, mask=valid, other=0.0)
    green = tl.load(d_colors + at * 3 + 1, mask=valid, other=0.0)
    blue = tl.load(d_colors + at * 3 + 2, mask=valid, other=0.0)
    d_x, d_y, d_z = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for index in tl.static_range(BASES):
        own, d_own = coefficients + at * (3 * BASES) + 3 * index, d_coefficients + at * (3 * BASES) + 3 * index
        value = tl.zeros((BLOCK,), tl.float32)
        if index < USED:
            value, slope_x, slope_y, slope_z = _harmonic(index, x, y, z)
            d_value = red * tl.load(own, mask=valid, other=0.0)
            d_value += green * tl.load(own + 1, mask=valid, other=0.0)
            d_value += blue * tl.load(own + 2, mask=valid, other=0.0)
            d_x += d_value * slope_x
            d_y += d_value * slope_y
            d_z += d_value * slope_z
        tl.store(d_own, value * red, mask=valid)
        tl.store(d_own + 1, value * green, mask=valid)
        tl.store(d_own + 2, value * blue, mask=valid)
    along = x * d_x + y * d_y + z * d_z
    tl.store(d_directions + at * 3, (d_x - along * x) * inverse, mask=valid)
    tl.store(d_directions + at * 3 + 1, (d_y - along * y) * inverse, mask=valid)
    tl.store(d_directions + at * 3 + 2, (d_z - along * z) * inverse, mask=valid)


class Harmonics(torch.autograd.Function):
    """(degree, directions [M, 3], coefficients [M, B, 3]) -> [M, 3]; float32, as `eval_sh` says."""

    @staticmethod
    def forward(ctx, degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
        directions, coefficients = directions.contiguous(), coefficients.contiguous()
        ctx.save_for_backward(directions, coefficients)
        ctx.used = (degree + 1) ** 2
        colors = torch.empty_like(directions)
        _launch(forward_kernel, ctx.used, directions, coefficients, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, d_colors: Tensor) -> tuple[None, Tensor, Tensor]:
        directions, coefficients = ctx.saved_tensors
        gradients = torch.empty_like(directions), torch.empty_like(coefficients)
        _launch(backward_kernel, ctx.used, directions, coefficients, d_colors.contiguous(), *gradients)
        return None, *gradients


def _launch(kernel: Any, used: int, directions: Tensor, coefficients: Tensor, *others: Tensor) -> None:
    count, bases = coefficients.shape[:2]
    if count > 0:
        grid = (-(-count // BLOCK),)
        kernel[grid](directions, coefficients, *others, count, USED=used, BASES=bases, BLOCK=BLOCK, num_warps=WARPS)
