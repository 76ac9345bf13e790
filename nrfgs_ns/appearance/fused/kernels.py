# SPDX-License-Identifier: Apache-2.0
"""The field in two Triton kernels. Names and memory layout: `packing.py`. Equations: `nrf.py`.

A program keeps the shared weights on chip and walks over blocks of visible splats. For a block of B splats it gathers
the rows of the table and computes

    X = [latents | features]  [B, 2P]        hidden = relu(X W1)  [B, H]        Y = hidden W2 + b2  [B, 16]

Nothing of that is written to memory: the backward kernel computes it again, which costs less than reading it.

What a splat has three or four of (direction, base colour and opacity, outputs) is a tile [B, 4], whose columns are
called lanes, and the features are R rows of such tiles, [B, R, 4] with P = 4 R: the kernels are bound by the number of
instructions, and a tile of four takes as many as one vector [B].

Rows are gathered with 64-bit offsets: 2^26 splats with 32 latents each pass 2^31 numbers.
"""

import triton
import triton.language as tl

OUT = tl.constexpr(16)  # columns of W2
PI = tl.constexpr(3.141592653589793)
FARTHEST = tl.constexpr(1e18)  # encoding.FARTHEST; the slope beyond, 0 there, is below 1e-18 here
SMOOTH_SHARPNESS = tl.constexpr(50.0)  # opacity_bound.SHARPNESS
LOGIT_SLOPE = tl.constexpr(4.0)  # opacity_bound.LOGIT_SLOPE


@triton.jit
def _sigmoid(x):
    return 1.0 / (1.0 + tl.exp(-x))


# The interpreter cuts floats down to bfloat16 and then multiplies their bits: there, operands are rounded by hand, and
# stay float32.
INTERPRETED = tl.constexpr(not isinstance(_sigmoid, triton.runtime.JITFunction))


@triton.jit
def _tanh(x):
    # Exactly 0 at 0, and no inf / inf at the ends.
    e = tl.exp(-2.0 * tl.abs(x))
    t = (1.0 - e) / (1.0 + e)
    return tl.where(x < 0.0, -t, t)


@triton.jit
def _operand(x, KIND: tl.constexpr):
    """Round to what the tensor cores multiply. float16 saturates: beyond 65504 it would be infinite.

    Tensor cores cut float32 down to tf32's 10 bits of mantissa; rounding first halves the error and takes its bias.
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
        bits = (x.to(tl.int32, bitcast=True) + 0x1000) & -0x2000
        return tl.where(x - x == 0.0, bits.to(tl.float32, bitcast=True), x)  # NaN and infinity stay
    else:
        return x


@triton.jit
def _dot(a, b, accumulator, KIND: tl.constexpr):
    """accumulator + a b, summed in float32."""
    if KIND == "tf32" or KIND == "tf32x3":
        return tl.dot(a, b, accumulator, input_precision=KIND)
    else:
        return tl.dot(a, b, accumulator, input_precision="ieee")


@triton.jit
def _last(tile, lanes):
    """Lane 3 of a tile [B, 4], as [B]."""
    return tl.sum(tl.where(lanes == 3, tile, 0.0), axis=1)


@triton.jit
def _view(means, centers, rows, items, mask, lanes, eps_squared, log_unit, ONE_CENTER: tl.constexpr):
    """encoding.view_geometry: direction [B, 4] (lane 3 is 0), log r in scene units, 1 / r, |v| above the floor."""
    if ONE_CENTER:
        center = tl.load(centers + lanes, mask=lanes < 3, other=0.0)
    else:
        center = tl.load(centers + items[:, None] * 3 + lanes, mask=mask, other=0.0)
    v = center - tl.load(means + rows[:, None] * 3 + lanes, mask=mask, other=0.0)
    v = tl.minimum(tl.maximum(v, -FARTHEST, tl.PropagateNan.ALL), FARTHEST, tl.PropagateNan.ALL)
    square = tl.sum(v * v, axis=1)
    r = tl.sqrt(tl.maximum(square, eps_squared, propagate_nan=tl.PropagateNan.ALL))
    inverse = 1.0 / r
    return v * inverse[:, None], tl.log(r) - log_unit, inverse, square >= eps_squared


@triton.jit
def _base(features_dc, opacities, rows, valid, mask, lanes, sh_c0):
    """(c, alpha) [B, 4], the opacity's logit and alpha, [B]."""
    dc = tl.load(features_dc + rows[:, None] * 3 + lanes, mask=mask, other=0.0)
    logit = tl.load(opacities + rows, mask=valid, other=0.0)
    alpha = _sigmoid(logit)
    return tl.where(lanes < 3, 0.5 + sh_c0 * dc, alpha[:, None]), logit, alpha


@triton.jit
def _cos_half_turns(y, shift):
    """cos(pi (y + shift)) for |shift| <= 1/2, within 2e-7.

    Half turns make the reduction to [-1, 1] exact, which the library's cosine pays for with a slow path and local
    memory. Then cos(pi z) = sin(pi (1/2 - z)) for z = |y + shift| folded into [0, 1], by an odd polynomial fitted for
    the least largest error (3e-9 in exact arithmetic).
    """
    y = y - 2.0 * tl.floor(0.5 * y + 0.5)
    z = tl.abs(y + shift)
    t = 0.5 - tl.minimum(z, 2.0 - z, propagate_nan=tl.PropagateNan.ALL)
    u = t * t
    p = 0.07722012850434533 * u - 0.5980451738703684
    p = p * u + 2.5500313772334837
    p = p * u - 5.167706878923152
    p = p * u + 3.1415925800446662
    return p * t


@triton.jit
def _waves(R: tl.constexpr):
    """Of each feature row, [1, R, 1]: its number, the frequency 2^k and the phase, in half turns, of its wave."""
    row = tl.arange(0, R)[None, :, None]
    band = tl.maximum(row - 1, 0) >> 1
    return row, (1 << band).to(tl.float32), tl.where((row & 1) == 1, -0.5, 0.0)


@triton.jit
def _features(d, base, log_r, lanes, R: tl.constexpr):
    """Features [B, R, 4], laid out as packing.py says."""
    row, frequency, phase = _waves(R)
    first = tl.where(lanes == 3, 1.0, d)
    waves = _cos_half_turns(d[:, None, :] * frequency, phase)
    features = tl.where(row == 0, first[:, None, :], tl.where(row == R - 1, base[:, None, :], waves))
    return tl.where((row == 1) & (lanes[:, None, :] == 3), log_r[:, None, None], features)


@triton.jit
def _features_backward(d_F, d, lanes, R: tl.constexpr):
    """From the features' gradient [B, R, 4] that of (direction, log r) and that of (c, alpha), both [B, 4]."""
    row, frequency, phase = _waves(R)
    # cos'(a) = cos(a + a quarter turn), by the chain rule times pi 2^k.
    slopes = _cos_half_turns(d[:, None, :] * frequency, phase + 0.5) * (frequency * PI)
    slopes = tl.where(row == 0, 1.0, tl.where(row == R - 1, 0.0, slopes))
    slopes = tl.where(lanes[:, None, :] == 3, tl.where(row == 1, 1.0, 0.0), slopes)
    return tl.sum(d_F * slopes, axis=1), tl.sum(tl.where(row == R - 1, d_F, 0.0), axis=1)


@triton.jit
def _smooth_tail(x):
    """log(1 + exp(-B |x|)) / B: how much softplus(B x) / B exceeds max(x, 0)."""
    return tl.log(1.0 + tl.exp(-tl.abs(x) * SMOOTH_SHARPNESS)) / SMOOTH_SHARPNESS


@triton.jit
def _bounded_opacity(logit, alpha, t, scale, BOUND: tl.constexpr):
    """Opacity [B], with its slopes by the logit and by t = tanh(d_alpha). See opacity_bound.py."""
    alpha_slope = alpha * (1.0 - alpha)
    if BOUND == "none":  # no residual: nothing to bound
        return alpha, alpha_slope, 0.0 * t
    elif BOUND == "logit":
        opacity = _sigmoid(logit + t * scale * LOGIT_SLOPE)
        slope = opacity * (1.0 - opacity)
        return opacity, slope, slope * scale * LOGIT_SLOPE
    else:
        x = alpha + scale * t
        clamped = tl.minimum(tl.maximum(x, 0.0, propagate_nan=tl.PropagateNan.ALL), 1.0, tl.PropagateNan.ALL)
        if BOUND == "smooth":
            slope = _sigmoid(x * SMOOTH_SHARPNESS) - _sigmoid((x - 1.0) * SMOOTH_SHARPNESS)
            return clamped + _smooth_tail(x) - _smooth_tail(x - 1.0), alpha_slope * slope, scale * slope
        elif BOUND == "clamp":
            slope = tl.where((x >= 0.0) & (x <= 1.0), 1.0, 0.0)
            return clamped, alpha_slope * slope, scale * slope
        else:  # straight-through
            return clamped, alpha_slope, scale + 0.0 * t


@triton.jit
def _outputs(Y, lanes, B: tl.constexpr):
    """High branch's outputs [B, 4], the gate's opening [B], and what tanh sees [B, 4]."""
    used, _ = tl.split(tl.reshape(Y, (B, 8, 2)))
    low, high = tl.split(tl.reshape(used, (B, 4, 2)))
    gate = _sigmoid(_last(high, lanes))
    return high, gate, low + tl.where(lanes < 3, gate[:, None] * high, 0.0)


@triton.jit
def forward_kernel(
    means, latents, features_dc, opacities, visible, centers, packed,
    colors_out, opacities_out,
    count, eps_squared, log_unit, color_scale, opacity_scale, sh_c0,
    D: tl.constexpr, P: tl.constexpr, H: tl.constexpr, B: tl.constexpr,
    ONE_CENTER: tl.constexpr, BOUND: tl.constexpr, KIND: tl.constexpr,
):  # fmt: skip
    """Colours [count, 3] and opacities [count] of the splats in rows `visible`."""
    columns = tl.arange(0, P)[None, :]
    lanes = tl.arange(0, 4)[None, :]
    outputs = tl.arange(0, OUT)
    units = tl.arange(0, H)
    inputs = tl.arange(0, 2 * P)
    W1 = _operand(tl.load(packed + inputs[:, None] * H + units[None, :]), KIND)
    W2 = _operand(tl.load(packed + 2 * P * H + units[:, None] * OUT + outputs[None, :]), KIND)
    b2 = tl.load(packed + 2 * P * H + H * OUT + outputs)

    for block in range(tl.program_id(0), tl.cdiv(count, B), tl.num_programs(0)):
        items = block * B + tl.arange(0, B).to(tl.int64)
        valid = items < count
        rows = tl.load(visible + items, mask=valid, other=0)
        mask = valid[:, None] & (lanes < 3)
        latent_mask = valid[:, None] & (columns < D)
        Z = tl.load(latents + rows[:, None] * D + columns, mask=latent_mask, other=0.0)
        d, log_r, _, _ = _view(means, centers, rows, items, mask, lanes, eps_squared, log_unit, ONE_CENTER)
        base, logit, alpha = _base(features_dc, opacities, rows, valid, mask, lanes, sh_c0)

        F = tl.reshape(_features(d, base, log_r, lanes, P // 4), (B, P))
        X = tl.reshape(tl.join(Z, F), (B, 2 * P))
        pre = _dot(_operand(X, KIND), W1, tl.zeros((B, H), tl.float32), KIND)
        hidden = tl.maximum(pre, 0.0, propagate_nan=tl.PropagateNan.ALL)
        Y = _dot(_operand(hidden, KIND), W2, tl.zeros((B, OUT), tl.float32), KIND) + b2[None, :]
        _, _, seen = _outputs(Y, lanes, B)
        t = _tanh(seen)

        color = tl.maximum(base + color_scale * t, 0.0, propagate_nan=tl.PropagateNan.ALL)
        tl.store(colors_out + items[:, None] * 3 + lanes, color, mask=mask)
        opacity, _, _ = _bounded_opacity(logit, alpha, _last(t, lanes), opacity_scale, BOUND)
        tl.store(opacities_out + items, opacity, mask=valid)


@triton.jit
def _give(pointers, values, mask, UNIQUE: tl.constexpr):
    """Hand a row its gradient: rows that occur once are written, others are added up."""
    if UNIQUE:
        tl.store(pointers, values, mask=mask)
    else:
        tl.atomic_add(pointers, values, mask=mask, sem="relaxed")


@triton.jit
def backward_kernel(
    means, latents, features_dc, opacities, visible, centers, packed,
    d_colors, d_opacities,
    d_means, d_latents, d_features_dc, d_logits, d_centers, partials,
    count, eps_squared, log_unit, color_scale, opacity_scale, sh_c0,
    D: tl.constexpr, P: tl.constexpr, H: tl.constexpr, B: tl.constexpr, SLOTS: tl.constexpr,
    ONE_CENTER: tl.constexpr, BOUND: tl.constexpr, GEOMETRY: tl.constexpr, CENTER: tl.constexpr,
    KIND: tl.constexpr, GRADIENT_KIND: tl.constexpr,
):  # fmt: skip
    """Gradients of everything, from those of colours and opacities.

    Rows of the tables' gradients that no block visits are left as they are. Each program writes its sum of the packed
    weights' gradients, and of one shared camera centre's, to its row of `partials` [programs, SLOTS]: no atomics, so
    the result is the same every time. A d_x here is the loss's derivative by x.
    """
    columns = tl.arange(0, P)[None, :]
    lanes = tl.arange(0, 4)[None, :]
    outputs = tl.arange(0, OUT)
    units = tl.arange(0, H)
    inputs = tl.arange(0, 2 * P)
    weights1 = tl.load(packed + inputs[:, None] * H + units[None, :])
    weights2 = tl.load(packed + 2 * P * H + units[:, None] * OUT + outputs[None, :])
    b2 = tl.load(packed + 2 * P * H + H * OUT + outputs)
    W1 = _operand(weights1, KIND)
    W2 = _operand(weights2, KIND)
    W1_T = tl.trans(_operand(weights1, GRADIENT_KIND))
    W2_T = tl.trans(_operand(weights2, GRADIENT_KIND))
    d_W1 = tl.zeros((2 * P, H), tl.float32)
    d_W2 = tl.zeros((H, OUT), tl.float32)
    d_b2 = tl.zeros((B, OUT), tl.float32)
    d_center = tl.zeros((B, 4), tl.float32)

    for block in range(tl.program_id(0), tl.cdiv(count, B), tl.num_programs(0)):
        items = block * B + tl.arange(0, B).to(tl.int64)
        valid = items < count
        rows = tl.load(visible + items, mask=valid, other=0)
        mask = valid[:, None] & (lanes < 3)
        latent_mask = valid[:, None] & (columns < D)
        Z = tl.load(latents + rows[:, None] * D + columns, mask=latent_mask, other=0.0)
        d, log_r, inverse, above = _view(means, centers, rows, items, mask, lanes, eps_squared, log_unit, ONE_CENTER)
        base, logit, alpha = _base(features_dc, opacities, rows, valid, mask, lanes, sh_c0)

        # Forward again.
        F = tl.reshape(_features(d, base, log_r, lanes, P // 4), (B, P))
        X = tl.reshape(tl.join(Z, F), (B, 2 * P))
        pre = _dot(_operand(X, KIND), W1, tl.zeros((B, H), tl.float32), KIND)
        hidden = tl.maximum(pre, 0.0, propagate_nan=tl.PropagateNan.ALL)
        Y = _dot(_operand(hidden, KIND), W2, tl.zeros((B, OUT), tl.float32), KIND) + b2[None, :]
        high, gate, seen = _outputs(Y, lanes, B)
        t = _tanh(seen)

        # Outputs.
        d_color = tl.load(d_colors + items[:, None] * 3 + lanes, mask=mask, other=0.0)
        d_color = tl.where(base + color_scale * t >= 0.0, d_color, 0.0)
        d_opacity = tl.load(d_opacities + items, mask=valid, other=0.0)
        _, logit_slope, t_slope = _bounded_opacity(logit, alpha, _last(t, lanes), opacity_scale, BOUND)
        d_t = tl.where(lanes < 3, color_scale * d_color, (d_opacity * t_slope)[:, None])
        d_low = d_t * (1.0 - t * t)
        d_gate = gate * (1.0 - gate) * tl.sum(tl.where(lanes < 3, d_low * high, 0.0), axis=1)
        d_high = tl.where(lanes < 3, gate[:, None] * d_low, d_gate[:, None])
        d_Y = tl.reshape(tl.join(d_low, d_high), (B, 8))
        d_Y = tl.reshape(tl.join(d_Y, tl.zeros((B, 8), tl.float32)), (B, OUT))
        d_b2 += d_Y

        # Layers. Which units are on is read from the rounded activations: kept apart, it costs the registers or the
        # instructions of a mask.
        hidden = _operand(hidden, GRADIENT_KIND)
        d_Y = _operand(d_Y, GRADIENT_KIND)
        d_hidden = _dot(d_Y, W2_T, tl.zeros((B, H), tl.float32), GRADIENT_KIND)
        d_W2 = _dot(tl.trans(hidden), d_Y, d_W2, GRADIENT_KIND)
        d_pre = _operand(tl.where(hidden > 0.0, d_hidden, 0.0), GRADIENT_KIND)
        d_X = _dot(d_pre, W1_T, tl.zeros((B, 2 * P), tl.float32), GRADIENT_KIND)
        d_W1 = _dot(tl.trans(_operand(X, GRADIENT_KIND)), d_pre, d_W1, GRADIENT_KIND)
        d_Z, d_F = tl.split(tl.reshape(d_X, (B, P, 2)))
        if INTERPRETED:
            d_Z = d_Z + 0.0  # the interpreter of Triton 3.6 adds up the halves of a split from the wrong places
        _give(d_latents + rows[:, None] * D + columns, d_Z, latent_mask, ONE_CENTER)

        # Features.
        d_view, d_base = _features_backward(tl.reshape(d_F, (B, P // 4, 4)), d, lanes, P // 4)
        _give(d_features_dc + rows[:, None] * 3 + lanes, sh_c0 * (d_base + d_color), mask, ONE_CENTER)
        d_logit = d_opacity * logit_slope + _last(d_base, lanes) * alpha * (1.0 - alpha)
        _give(d_logits + rows, d_logit, valid, ONE_CENTER)

        # Geometry: d = v / r and log r, where r is floored and has no slope below the floor.
        if GEOMETRY:
            radial = tl.sum(tl.where(lanes < 3, -d_view * d, d_view), axis=1)
            radial = tl.where(above, radial, 0.0)
            d_v = inverse[:, None] * (d_view + radial[:, None] * d)
            _give(d_means + rows[:, None] * 3 + lanes, -d_v, mask, ONE_CENTER)
            if CENTER and ONE_CENTER:
                d_center += tl.where(mask, d_v, 0.0)
            if CENTER and not ONE_CENTER:
                tl.store(d_centers + items[:, None] * 3 + lanes, d_v, mask=mask)

    mine = partials + tl.program_id(0) * SLOTS
    tl.store(mine + inputs[:, None] * H + units[None, :], d_W1)
    tl.store(mine + 2 * P * H + units[:, None] * OUT + outputs[None, :], d_W2)
    tl.store(mine + 2 * P * H + H * OUT + outputs, tl.sum(d_b2, axis=0))
    tl.store(mine + 2 * P * H + H * OUT + OUT + tl.arange(0, 4), tl.sum(d_center, axis=0))
