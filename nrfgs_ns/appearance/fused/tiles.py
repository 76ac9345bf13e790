# SPDX-License-Identifier: Apache-2.0
"""How the fused kernels read and write rows of tables: every number in the thread in which tensor cores want it.

The compiler deals the rows of a load to the threads, four for each row: eight rows to each warp, and then eight more to
each. Tensor cores want sixteen neighbours in a warp. Which row of a matrix a splat is does not matter, so rows are
renumbered such that every number is already where it belongs. That costs nothing. A thread reads four numbers of a row
at once, so latents come in sixteens. What D, P, R and B are: packing.py and kernels.py.
"""

import triton
import triton.language as tl


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
def read_four(threes, ones, rows, mask, lanes):
    """Rows [B, 1] of a table of three columns, and in lane 3 of a table of one; 0 where `mask` [B, 1] is false. In the
    order of a load."""
    three = tl.load(threes + rows * 3 + lanes, mask=mask & (lanes < 3), other=0.0)
    one = tl.load(ones + rows + (lanes - 3), mask=mask & (lanes == 3), other=0.0)
    return tl.where(lanes < 3, three, one)


@triton.jit
def load_four(threes, ones, rows, mask, lanes, B: tl.constexpr):
    """The same in the order of tensor cores."""
    return regroup(read_four(threes, ones, rows, mask, lanes), B)


@triton.jit
def load_flags(flags, rows, B: tl.constexpr):
    """Rows [B, 1] of a table of int32: whether they are not 0, the same in all lanes."""
    return regroup(tl.broadcast_to(tl.load(flags + rows), (B, 4)), B) != 0


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
def give(pointers, values, mask, UNIQUE: tl.constexpr):
    """Hand a row its gradient: rows that occur once are written, others are added up."""
    if UNIQUE:
        tl.store(pointers, values, mask=mask)
    else:
        tl.atomic_add(pointers, values, mask=mask, sem="relaxed")


@triton.jit
def give_latents(d_latents, rows, d_Z, valid, D: tl.constexpr, P: tl.constexpr, B: tl.constexpr, UNIQUE: tl.constexpr):
    """The inverse of load_latents, for their gradients."""
    stacked = tl.permute(tl.reshape(d_Z, (B, P // 16, 16)), (0, 2, 1))
    twos: tl.constexpr = 2 if P == 64 else 1 if P == 32 else 0
    pieces = unstack(tl.reshape(stacked, (B, 16) + (2,) * twos), P // 16)
    for i in tl.static_range(P // 16):
        columns = 16 * i + tl.arange(0, 16)[None, :]
        piece = tl.permute(tl.reshape(pieces[i], (B // 16, 2, 8, 4, 4)), (1, 0, 2, 4, 3))
        give(d_latents + rows * D + columns, tl.reshape(piece, (B, 16)), valid & (columns < D), UNIQUE)
