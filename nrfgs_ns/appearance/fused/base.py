# SPDX-License-Identifier: Apache-2.0
"""What needs no network in the fused kernels: base colours and opacities, and blocks of which all splats are diffuse.

A program first walks backwards over its last blocks, as long as all their splats are diffuse, and does without the
network there. Diffuse splats come last in the table (`appearance/diffuse.py`), so that these are all blocks that have
some, but one. A branch in the loop that the network runs in would serve a table in any order, but it keeps
the compiler from loading the next blocks while one is computed.

Tiles [B, 4], B, lanes, and what the arguments are: `kernels.py`.
"""

import triton
import triton.language as tl

from nrfgs_ns.appearance.fused.arithmetic import sigmoid
from nrfgs_ns.appearance.fused.tiles import give, read_four


@triton.jit
def base_of(stored, lanes, sh_c0):
    """(c, alpha) from what is stored: features_dc, and the logit in lane 3."""
    return tl.where(lanes < 3, 0.5 + sh_c0 * stored, sigmoid(stored))


@triton.jit
def _last_block(count, B: tl.constexpr):
    """The last block that this program walks over."""
    first = tl.program_id(0)
    return first + (tl.cdiv(count, B) - 1 - first) // tl.num_programs(0) * tl.num_programs(0)


@triton.jit
def _all_diffuse(diffuse, visible, block, count, B: tl.constexpr):
    """Whether every splat of a block is diffuse; no for negative blocks, of which there are none."""
    items = tl.minimum(block * B + tl.arange(0, B), count - 1).to(tl.int64)
    rows = tl.load(visible + items, mask=items >= 0, other=0)
    return tl.min(tl.load(diffuse + rows, mask=items >= 0, other=0), axis=0) > 0


@triton.jit
def forward_base(
    features_dc, opacities, diffuse, visible, colors_out, opacities_out, count, sh_c0, lanes, B: tl.constexpr
):  # fmt: skip
    """Do this program's last blocks, as long as they need no network. Returns the end of those that are left to do."""
    block = _last_block(count, B)
    done = _all_diffuse(diffuse, visible, block, count, B)
    while done:
        items = block * B + tl.arange(0, B)[:, None]
        valid = items < count
        items = tl.minimum(items, count - 1).to(tl.int64)
        base = base_of(read_four(features_dc, opacities, tl.load(visible + items), valid, lanes), lanes, sh_c0)
        out = tl.maximum(base, 0.0, propagate_nan=tl.PropagateNan.ALL)
        tl.store(colors_out + items * 3 + lanes, out, mask=valid & (lanes < 3))
        tl.store(opacities_out + items + (lanes - 3), out, mask=valid & (lanes == 3))
        block -= tl.num_programs(0)
        done = _all_diffuse(diffuse, visible, block, count, B)
    return block + 1


@triton.jit
def backward_base(
    features_dc, opacities, diffuse, visible, d_colors, d_opacities, d_features_dc, d_logits, count, sh_c0, lanes,
    B: tl.constexpr, UNIQUE: tl.constexpr,
):  # fmt: skip
    """The same for gradients. Those by latents, means and centres are 0, and have been before."""
    block = _last_block(count, B)
    done = _all_diffuse(diffuse, visible, block, count, B)
    while done:
        items = block * B + tl.arange(0, B)[:, None]
        valid = items < count
        items = tl.minimum(items, count - 1).to(tl.int64)
        rows = tl.load(visible + items)
        base = base_of(read_four(features_dc, opacities, rows, valid, lanes), lanes, sh_c0)
        d_out = read_four(d_colors, d_opacities, items, valid, lanes)
        d_color = tl.where(base >= 0.0, d_out, 0.0)
        d_stored = tl.where(lanes < 3, sh_c0 * d_color, d_out * (base * (1.0 - base)))
        give(d_features_dc + rows * 3 + lanes, d_stored, valid & (lanes < 3), UNIQUE)
        give(d_logits + rows + (lanes - 3), d_stored, valid & (lanes == 3), UNIQUE)
        block -= tl.num_programs(0)
        done = _all_diffuse(diffuse, visible, block, count, B)
    return block + 1
