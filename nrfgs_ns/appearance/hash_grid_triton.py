# SPDX-License-Identifier: Apache-2.0
"""The hash grid in two Triton kernels, one forward and one backward. Equations: `hash_grid.py`.

A thread takes positions and walks over the eight corners of a level's cell, all in registers. Forward, a program has
one level, so that neighbouring programs gather from the same table. Backward, it has all of them: a position's gradient
is their sum, written once. The table's gradient is added up by atomics, so its last bits differ from run to run, as
those of PyTorch's index_select do.

Lattice coordinates are int32 and the hash is unsigned 32-bit: the rows are those of `hash_grid.py` wherever coordinates
are below 2^31, and stay at the last float32 below it beyond. A position that is NaN, or infinite on the lattice, gets
NaN, as in PyTorch; no row is beyond the table.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.kernels.launch import Launcher

BLOCK = 128
"""Positions of a program: one for each thread, with four features of each corner."""
# Nothing is fused: far out, position * N_l is rounded by more than a step, and fused with the subtraction of its
# floor that rounding would come back as the distance into the cell. There is nothing to pipeline either.
OPTIONS = {"num_warps": 4, "num_stages": 1, "enable_fp_fusion": False}

PRIME_X, PRIME_Y, PRIME_Z = tl.constexpr(1), tl.constexpr(2654435761), tl.constexpr(805459861)  # hash_grid.PRIMES
FARTHEST = tl.constexpr(2.0**31 - 2.0**7)  # the last float32 that an int32 holds
CORNERS = tl.constexpr(8)


@triton.jit
def _block(positions, count, F: tl.constexpr, B: tl.constexpr):
    """A program's positions: int64 [B], which are valid, x, y and z; lanes [1, F]."""
    items = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    lanes = tl.arange(0, F)[None, :]
    valid = items < count
    x = tl.load(positions + items * 3, mask=valid, other=0.0)
    y = tl.load(positions + items * 3 + 1, mask=valid, other=0.0)
    z = tl.load(positions + items * 3 + 2, mask=valid, other=0.0)
    return items, valid, x, y, z, lanes


@triton.jit
def _split(coordinate, resolution):
    """Lattice coordinate below, and the weights of the lower and the upper neighbour."""
    scaled = coordinate * resolution
    below = tl.floor(scaled)
    after = scaled - below
    return tl.minimum(tl.maximum(below, -FARTHEST), FARTHEST).to(tl.int32), (1.0 - after, after)


@triton.jit
def _keys(cell, numbered, side, stride, PRIME: tl.constexpr):
    """An axis's share of the rows of the lower and the upper neighbour, uint32."""
    if numbered:
        lower = cell % side  # has the sign of the cell
        lower = tl.where(lower < 0, lower + side, lower)
        upper = tl.where(lower == side - 1, 0, lower + 1)
        lower_key, upper_key = (lower * stride).to(tl.uint32), (upper * stride).to(tl.uint32)
    else:
        lower_key = cell.to(tl.uint32, bitcast=True) * PRIME
        upper_key = lower_key + PRIME
    return lower_key, upper_key


@triton.jit
def _level(x, y, z, level, resolutions, numbered_levels):
    """Whether the level is numbered; keys and weights of each axis, at positions (x, y, z)."""
    resolution = tl.load(resolutions + level)
    numbered = level < numbered_levels
    side = (2.0 * resolution).to(tl.int32)
    x_cell, x_weights = _split(x, resolution)
    y_cell, y_weights = _split(y, resolution)
    z_cell, z_weights = _split(z, resolution)
    x_keys = _keys(x_cell, numbered, side, 1, PRIME_X)
    y_keys = _keys(y_cell, numbered, side, side, PRIME_Y)
    z_keys = _keys(z_cell, numbered, side, side * side, PRIME_Z)
    return resolution, numbered, (x_keys, y_keys, z_keys), (x_weights, y_weights, z_weights)


@triton.jit
def _offsets(keys, numbered, table_size, CORNER: tl.constexpr, F: tl.constexpr):
    """Starts of a corner's features in the level's table, int64 [B, 1]. Corner 4 i + 2 j + k is the upper one on x, y,
    z where i, j, k are 1."""
    a, b, c = keys[0][CORNER // 4], keys[1][CORNER // 2 % 2], keys[2][CORNER % 2]
    rows = tl.where(numbered, a + b + c, (a ^ b ^ c) & (table_size - 1).to(tl.uint32))
    return rows.to(tl.int64)[:, None] * F


@triton.jit
def _weight(weights, CORNER: tl.constexpr):
    """A corner's weight, [B]."""
    return weights[0][CORNER // 4] * weights[1][CORNER // 2 % 2] * weights[2][CORNER % 2]


@triton.jit(do_not_specialize=["count", "levels", "numbered_levels", "table_size"])
def forward_kernel(
    positions, table, resolutions, features,
    count, levels, numbered_levels, table_size,
    F: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Features [count, levels * F] of positions [count, 3]; program (i, l) computes block i of level l."""
    level = tl.program_id(1)
    items, valid, x, y, z, lanes = _block(positions, count, F, B)
    _, numbered, keys, weights = _level(x, y, z, level, resolutions, numbered_levels)
    level_table = table + tl.cast(level, tl.int64) * table_size * F
    total = tl.zeros((B, F), tl.float32)
    for corner in tl.static_range(CORNERS):
        offsets = _offsets(keys, numbered, table_size, corner, F) + lanes
        total += _weight(weights, corner)[:, None] * tl.load(level_table + offsets)
    begin = items[:, None] * (levels * F) + level * F
    tl.store(features + begin + lanes, total, mask=valid[:, None])


@triton.jit(do_not_specialize=["count", "levels", "numbered_levels", "table_size"])
def backward_kernel(
    positions, table, resolutions, d_features, d_positions, d_table,
    count, levels, numbered_levels, table_size,
    F: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Gradients of positions (written) and of the table (added)."""
    items, valid, x, y, z, lanes = _block(positions, count, F, B)
    here = valid[:, None]

    d_x, d_y, d_z = tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32)
    for level in range(levels):
        resolution, numbered, keys, weights = _level(x, y, z, level, resolutions, numbered_levels)
        level_begin = tl.cast(level, tl.int64) * table_size * F
        begin = items[:, None] * (levels * F) + level * F
        upstream = tl.load(d_features + begin + lanes, mask=here, other=0.0)

        # All corners are read before any is added to: the compiler does not move a load past an atomic.
        by_x, by_y, by_z = tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32)
        for corner in tl.static_range(CORNERS):
            offsets = _offsets(keys, numbered, table_size, corner, F) + lanes
            read = tl.load(table + level_begin + offsets)
            by_weight = tl.sum(read * upstream, axis=1)
            w_x, w_y, w_z = weights[0][corner // 4], weights[1][corner // 2 % 2], weights[2][corner % 2]
            by_x += w_y * w_z * by_weight * (2 * (corner // 4) - 1)
            by_y += w_x * w_z * by_weight * (2 * (corner // 2 % 2) - 1)
            by_z += w_x * w_y * by_weight * (2 * (corner % 2) - 1)
        d_x += by_x * resolution
        d_y += by_y * resolution
        d_z += by_z * resolution

        for corner in tl.static_range(CORNERS):
            offsets = _offsets(keys, numbered, table_size, corner, F) + lanes
            gradient = _weight(weights, corner)[:, None] * upstream
            tl.atomic_add(d_table + level_begin + offsets, gradient, mask=here, sem="relaxed")

    tl.store(d_positions + items * 3, d_x, mask=valid)
    tl.store(d_positions + items * 3 + 1, d_y, mask=valid)
    tl.store(d_positions + items * 3 + 2, d_z, mask=valid)


launch_forward, launch_backward = Launcher(forward_kernel), Launcher(backward_kernel)


class Interpolation(torch.autograd.Function):
    """(positions [M, 3], table [L T, F], resolutions [L]) -> features [M, L F]; all float32 on one device.

    The first `numbered_levels` are numbered; T is a power of two up to 2^24, F a power of two.
    """

    @staticmethod
    def forward(ctx, positions: Tensor, table: Tensor, resolutions: Tensor, numbered_levels: int, table_size: int):
        positions, table = positions.detach().contiguous(), table.detach().contiguous()
        ctx.save_for_backward(positions, table, resolutions)
        ctx.sizes = sizes = len(positions), len(resolutions), numbered_levels, table_size
        features = positions.new_empty(len(positions), len(resolutions) * table.shape[1])
        if len(positions) > 0:
            grid = triton.cdiv(len(positions), BLOCK), len(resolutions), 1
            launch_forward(grid, positions, table, resolutions, features, *sizes, F=table.shape[1], B=BLOCK, **OPTIONS)
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx, d_features: Tensor):
        positions, table, resolutions = ctx.saved_tensors
        d_positions, d_table = torch.empty_like(positions), torch.zeros_like(table)
        if len(positions) > 0:
            launch_backward(
                (triton.cdiv(len(positions), BLOCK), 1, 1), positions, table, resolutions, d_features.contiguous(),
                d_positions, d_table, *ctx.sizes, F=table.shape[1], B=BLOCK, **OPTIONS,
            )  # fmt: skip
        return d_positions, d_table, None, None, None
