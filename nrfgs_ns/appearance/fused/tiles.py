# SPDX-License-Identifier: Apache-2.0
"""Building blocks of the fused kernels: functions and products on tensor cores, and access to tables.

Every number is read by the thread in which tensor cores need it, so that nothing moves between threads. The compiler
gives four threads to each row of a load, and eight rows, then eight more, to each warp. Tensor cores need sixteen
neighbouring rows in a warp. The order of splats in a matrix is free, so rows are renumbered at no cost. A thread reads
four numbers of a row at once, so latents come in sixteens. D, P, R and B: packing.py and kernels.py.
"""

import triton
import triton.language as tl


@triton.jit
def inverse(x):
    """1 / x for x >= 1. The root's inverse is one instruction of the card, a division several."""
    root = tl.rsqrt(x)
    return root * root


@triton.jit
def sigmoid(x):
    return inverse(1.0 + tl.exp(-x))


# The interpreter truncates to bfloat16 and multiplies the bits as integers: there, operands are rounded by hand, and
# stay float32.
INTERPRETED = tl.constexpr(not isinstance(sigmoid, triton.runtime.JITFunction))


@triton.jit
def tanh(x):
    # Exactly 0 at 0, and no inf / inf at the ends.
    e = tl.exp(-2.0 * tl.abs(x))
    t = (1.0 - e) * inverse(1.0 + e)
    return tl.where(x < 0.0, -t, t)


@triton.jit
def operand(x, KIND: tl.constexpr):
    """Round a factor as tensor cores take it. float16 saturates: beyond 65504 it would be infinite.

    Tensor cores cut float32 down to tf32's 10 bits of mantissa; rounding first halves the error and removes its bias.
    """
    if KIND == "fp16":
        x = tl.where(x > 65504.0, 65504.0, x)
        x = tl.where(x < -65504.0, -65504.0, x)
        rounded = x.to(tl.float16)
        return rounded.to(tl.float32) if INTERPRETED else rounded
    elif KIND == "bf16":
        if INTERPRETED:
            bits = x.to(tl.int32, bitcast=True)
            bits = (bits + 0x7FFF + ((bits >> 16) & 1)) & -0x10000
            return bits.to(tl.float32, bitcast=True)
        else:
            return x.to(tl.bfloat16)
    elif KIND == "tf32":
        # NaN and infinity stay, recognised by their bits: where x is a product, fused multiply-add would make x - x the
        # product's rounding error, not 0.
        bits = x.to(tl.int32, bitcast=True)
        rounded = (bits + 0x1000) & -0x2000
        return tl.where((bits & 0x7F800000) == 0x7F800000, x, rounded.to(tl.float32, bitcast=True))
    else:
        return x


@triton.jit
def dot(a, b, accumulator, KIND: tl.constexpr):
    """Accumulator + a b, summed in float32."""
    if KIND == "tf32" or KIND == "tf32x3":
        return tl.dot(a, b, accumulator, input_precision=KIND)
    else:
        return tl.dot(a, b, accumulator, input_precision="ieee")


@triton.jit
def sin_half_turns(t):
    """sin(pi t) for |t| <= 1/2, by an odd polynomial fitted for the least largest error (3e-9 in exact arithmetic)."""
    u = t * t
    p = 0.07722012850434533 * u - 0.5980451738703684
    p = p * u + 2.5500313772334837
    p = p * u - 5.167706878923152
    p = p * u + 3.1415925800446662
    return p * t


@triton.jit
def last(tile, lanes):
    """Lane 3 of a tile, as [B, 1]."""
    return tl.sum(tl.where(lanes == 3, tile, 0.0), axis=1)[:, None]


@triton.jit
def stack(tiles, R: tl.constexpr):
    """R tiles [B, 4] -> [B, 4, 2, 2, ..], R written in twos."""
    if R == 1:
        return tiles[0]
    else:
        return tl.join(stack(tiles[0:R:2], R // 2), stack(tiles[1:R:2], R // 2))


@triton.jit
def unstack(x, R: tl.constexpr):
    """The inverse of stack."""
    if R == 1:
        return (x,)
    else:
        even, odd = tl.split(x)
        evens, odds = unstack(even, R // 2), unstack(odd, R // 2)
        tiles = (evens[0], odds[0])
        for i in tl.static_range(1, R // 2):
            tiles = tiles + (evens[i], odds[i])
        return tiles


@triton.jit
def regroup(tile, B: tl.constexpr):
    """A tile in the order of a load -> in the order of tensor cores."""
    return tl.reshape(tl.permute(tl.reshape(tile, (2, B // 16, 8, 4)), (1, 0, 2, 3)), (B, 4))


@triton.jit
def deal(tile, B: tl.constexpr):
    """The inverse of regroup."""
    return tl.reshape(tl.permute(tl.reshape(tile, (B // 16, 2, 8, 4)), (1, 0, 2, 3)), (B, 4))


@triton.jit
def load_three(table, rows, lanes, B: tl.constexpr):
    """Rows [B, 1] of a table of three columns; lane 3 is 0."""
    return regroup(tl.load(table + rows * 3 + lanes, mask=lanes < 3, other=0.0), B)


@triton.jit
def load_four(threes, ones, rows, mask, lanes, B: tl.constexpr):
    """Rows [B, 1] of a table of three columns, and in lane 3 of a table of one; 0 where `mask` [B, 1] is false."""
    three = tl.load(threes + rows * 3 + lanes, mask=mask & (lanes < 3), other=0.0)
    one = tl.load(ones + rows + (lanes - 3), mask=mask & (lanes == 3), other=0.0)
    return regroup(tl.where(lanes < 3, three, one), B)


@triton.jit
def load_latents(latents, rows, D: tl.constexpr, P: tl.constexpr, B: tl.constexpr):
    """Latents [B, P], laid out as packing.py says."""
    pieces = ()
    for i in tl.static_range(P // 16):
        columns = 16 * i + tl.arange(0, 16)[None, :]
        piece = tl.load(latents + rows * D + columns, mask=columns < D, other=0.0)
        piece = tl.permute(tl.reshape(piece, (2, B // 16, 8, 4, 4)), (1, 0, 2, 4, 3))
        pieces = pieces + (tl.reshape(piece, (B, 16)),)
    stacked = tl.reshape(stack(pieces, P // 16), (B, 16, P // 16))
    return tl.reshape(tl.permute(stacked, (0, 2, 1)), (B, P))


@triton.jit
def store_gradients(pointers, values, mask, UNIQUE: tl.constexpr):
    """Write gradients to rows of a table; with rows that may repeat (not UNIQUE), add them up."""
    if UNIQUE:
        tl.store(pointers, values, mask=mask)
    else:
        tl.atomic_add(pointers, values, mask=mask, sem="relaxed")


@triton.jit
def store_latents(d_latents, rows, d_Z, valid, D: tl.constexpr, P: tl.constexpr, B: tl.constexpr, UNIQUE: tl.constexpr):
    """`store_gradients` of d_Z [B, P], laid out as by load_latents."""
    stacked = tl.permute(tl.reshape(d_Z, (B, P // 16, 16)), (0, 2, 1))
    twos: tl.constexpr = 2 if P == 64 else 1 if P == 32 else 0
    pieces = unstack(tl.reshape(stacked, (B, 16) + (2,) * twos), P // 16)
    for i in tl.static_range(P // 16):
        columns = 16 * i + tl.arange(0, 16)[None, :]
        piece = tl.permute(tl.reshape(pieces[i], (B // 16, 2, 8, 4, 4)), (1, 0, 2, 4, 3))
        store_gradients(d_latents + rows * D + columns, tl.reshape(piece, (B, 16)), valid & (columns < D), UNIQUE)
