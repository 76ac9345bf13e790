# SPDX-License-Identifier: Apache-2.0
"""Arithmetic of the fused kernels: sigmoid, tanh and sine, and products on tensor cores with what they round."""

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


# The interpreter cuts floats down to bfloat16 and then multiplies their bits: there, operands are rounded by hand, and
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
    """Round to what the tensor cores multiply. float16 saturates: beyond 65504 it would be infinite.

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
        # NaN and infinity stay. They are told by their bits: where x is a product, fused multiply-add takes x - x for
        # the product's rounding error, which is not 0.
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
