# SPDX-License-Identifier: Apache-2.0
"""The field in two Triton kernels. Names and memory layout: `packing.py`. Equations: `nrf.py`.

A program keeps the shared weights on chip and walks over blocks of visible splats. For a block of B splats it gathers
the rows of the table and computes

    X = [latents | features]  [B, 2P]        hidden = relu(X W1)  [B, H]        Y = hidden W2 + b2  [B, 8]

Nothing of that is written to memory: the backward kernel computes it again, which costs less than reading it.

Direction, base colour and opacity, outputs and their gradients are tiles [B, 4] whose columns are called lanes: three
axes or colours, and in lane 3 the opacity or the gate. The features are R tiles. A splat's lanes stay in the four
threads in which tensor cores have its row, latents and features (`tiles.py`).

The kernels are bound by instructions and by threads that wait for each other. So bands follow from one another by
double angles, the backward kernel's slopes are the forward's waves, nothing is divided, and the next blocks are loaded
while one is computed. Rows have 64-bit offsets: 2^26 splats with 32 latents each pass 2^31 numbers.
"""

import triton
import triton.language as tl

from nrfgs_ns.appearance.fused.tiles import (
    deal,
    dot,
    last,
    load_four,
    load_latents,
    load_three,
    operand,
    sigmoid,
    sin_half_turns,
    stack,
    store_gradients,
    store_latents,
    tanh,
    unstack,
)  # fmt: skip

OUTPUTS = tl.constexpr(8)  # packing.OUTPUT_COLUMNS
PI = tl.constexpr(3.141592653589793)
HALF_LOG_2 = tl.constexpr(0.34657359027997264)
FARTHEST = tl.constexpr(1e18)  # nrf.FARTHEST; beyond it the twin's slope is 0, this one's below 1e-18
LOGIT_SLOPE = tl.constexpr(4.0)  # nrf.LOGIT_SLOPE


# Tiles [B, 4].


@triton.jit
def _view(means, centers, rows, items, lanes, eps_squared, log_unit, B: tl.constexpr, ONE_CENTER: tl.constexpr):
    """nrf.view_geometry: direction (lane 3 is 0); log r in scene units, 1 / r and whether |v| >= eps, [B, 1]."""
    if ONE_CENTER:
        center = tl.load(centers + lanes, mask=lanes < 3, other=0.0)
    else:
        center = load_three(centers, items, lanes, B)
    v = center - load_three(means, rows, lanes, B)
    v = tl.minimum(tl.maximum(v, -FARTHEST, tl.PropagateNan.ALL), FARTHEST, tl.PropagateNan.ALL)
    square = tl.sum(v * v, axis=1)[:, None]
    floored = tl.maximum(square, eps_squared, propagate_nan=tl.PropagateNan.ALL)
    inv_r = tl.rsqrt(floored)
    return v * inv_r, HALF_LOG_2 * tl.log2(floored) - log_unit, inv_r, square >= eps_squared


# Features.


@triton.jit
def _waves(d, BANDS: tl.constexpr):
    """nrf.fourier_bands: tiles (sin(pi d), cos(pi d), sin(2 pi d), cos(2 pi d), ..), two for each band.

    Band 0 within 2e-7: half turns make the reduction to [-1/2, 1/2] exact. Every other band by double angles,

        sin 2a = 2 sin a cos a        cos 2a = cos^2 a - sin^2 a

    which doubles an error (x, y) of (sin a, cos a) and rounds by less than 1e-7 (2^-25 the sine; 2^-25 + 2^-26 + 2^-25
    the cosine). So band k is within 2^k (2^1/2 2e-7 + 1e-7) < 2^k 4e-7; measured: 2^k 2.2e-7. Rounding d alone moves it
    by up to 2^k pi 2^-25, which is 2^k 1e-7.
    """
    z = tl.abs(d)
    t = tl.minimum(z, 1.0 - z, propagate_nan=tl.PropagateNan.ALL)
    s, c = sin_half_turns(tl.where(d < 0.0, -t, t)), sin_half_turns(0.5 - z)
    waves = (s, c)
    for _ in tl.static_range(BANDS - 1):
        s, c = 2.0 * s * c, c * c - s * s
        waves = waves + (s, c)
    return waves


@triton.jit
def _features(d, base, log_r, waves, lanes, B: tl.constexpr, R: tl.constexpr, BANDS: tl.constexpr):
    """Features [B, P], laid out as packing.py says."""
    tiles = (tl.where(lanes == 3, 1.0, d), tl.where(lanes == 3, log_r, waves[0])) + waves[1:]
    for _ in tl.static_range(R - 2 * BANDS - 2):
        tiles = tiles + (tl.zeros_like(d),)
    stacked = tl.reshape(stack(tiles + (base,), R), (B, 4, R))
    return tl.reshape(tl.permute(stacked, (0, 2, 1)), (B, 4 * R))


@triton.jit
def _features_backward(d_F, waves, lanes, B: tl.constexpr, R: tl.constexpr, BANDS: tl.constexpr):
    """Gradients of (direction, log r) and of (c, alpha), from the features' [B, P]."""
    stacked = tl.permute(tl.reshape(d_F, (B, R, 4)), (0, 2, 1))
    twos: tl.constexpr = 4 if R == 16 else 3 if R == 8 else 2
    tiles = unstack(tl.reshape(stacked, (B, 4) + (2,) * twos), R)
    # Band k adds 2^k pi (cos g_sin - sin g_cos) to the direction's gradient. Summed from the highest band down, the
    # factor 2^k comes from doubling the sum at each step.
    slope_sum = waves[2 * BANDS - 1] * tiles[2 * BANDS - 1] - waves[2 * BANDS - 2] * tiles[2 * BANDS]
    for k in tl.static_range(BANDS - 2, -1, -1):
        slope_sum = 2.0 * slope_sum + (waves[2 * k + 1] * tiles[2 * k + 1] - waves[2 * k] * tiles[2 * k + 2])
    return tl.where(lanes == 3, tiles[1], tiles[0] + PI * slope_sum), tiles[R - 1]


# Outputs.


@triton.jit
def _bounded_opacity(logit, alpha, t, scale, BOUND: tl.constexpr):
    """Opacity, and its derivatives by the logit and by t = tanh(d_alpha), which is 0 without a residual. See nrf.py."""
    alpha_slope = alpha * (1.0 - alpha)
    if BOUND == "logit":
        opacity = sigmoid(logit + t * scale * LOGIT_SLOPE)
        slope = opacity * (1.0 - opacity)
        return opacity, slope, slope * scale * LOGIT_SLOPE
    else:  # straight-through
        x = alpha + scale * t
        clamped = tl.minimum(tl.maximum(x, 0.0, propagate_nan=tl.PropagateNan.ALL), 1.0, tl.PropagateNan.ALL)
        return clamped, alpha_slope, scale + 0.0 * t


@triton.jit
def _outputs(Y, lanes, B: tl.constexpr, COLUMNS: tl.constexpr):
    """(dc_high, w) [B, 4], the gate sigmoid(w) [B, 1], and tanh's argument [B, 4]: dc in lanes 0..2, d_alpha in 3."""
    if COLUMNS == 16:
        Y, _ = tl.split(tl.permute(tl.reshape(Y, (B, 2, 8)), (0, 2, 1)))
    low, high = tl.split(tl.reshape(Y, (B, 4, 2)))
    gate = sigmoid(last(high, lanes))
    return high, gate, low + tl.where(lanes < 3, gate * high, 0.0)


@triton.jit
def _padded(Y, B: tl.constexpr):
    """[B, 8] -> [B, 16], zeros behind: a tensor core sums over 16 at once."""
    return tl.reshape(tl.permute(tl.join(Y, tl.zeros_like(Y)), (0, 2, 1)), (B, 16))


@triton.jit
def _inputs(Z, F, B: tl.constexpr, P: tl.constexpr, KIND: tl.constexpr):
    """X [B, 2P]: latents in even columns, features in odd ones."""
    return tl.reshape(tl.join(operand(Z, KIND), operand(F, KIND)), (B, 2 * P))


@triton.jit
def base_appearance(stored, lanes, sh_c0):
    """(c, alpha) from features_dc, and the logit in lane 3."""
    return tl.where(lanes < 3, 0.5 + sh_c0 * stored, sigmoid(stored))


@triton.jit(do_not_specialize=["count"])
def forward_kernel(
    means, latents, features_dc, opacities, visible, centers, packed,
    colors_out, opacities_out,
    count, eps_squared, log_unit, color_scale, opacity_scale, sh_c0,
    D: tl.constexpr, P: tl.constexpr, H: tl.constexpr, BANDS: tl.constexpr, B: tl.constexpr, COLUMNS: tl.constexpr,
    ONE_CENTER: tl.constexpr, BOUND: tl.constexpr, KIND: tl.constexpr,
):  # fmt: skip
    """Colours [count, 3] and opacities [count] of the splats in rows `visible`."""
    lanes = tl.arange(0, 4)[None, :]
    outputs = tl.arange(0, COLUMNS)
    units = tl.arange(0, H)
    inputs = tl.arange(0, 2 * P)
    layer2 = packed + 2 * P * H
    real = outputs < OUTPUTS
    W1 = operand(tl.load(packed + inputs[:, None] * H + units[None, :]), KIND)
    W2 = tl.load(layer2 + units[:, None] * OUTPUTS + outputs[None, :], mask=real[None, :], other=0.0)
    W2 = operand(W2, KIND)
    b2 = tl.load(layer2 + H * OUTPUTS + outputs, mask=real, other=0.0)

    # Values hoisted out of the loop would take registers that its inside needs.
    for block in tl.range(tl.program_id(0), tl.cdiv(count, B), tl.num_programs(0), disable_licm=True):
        items = block * B + tl.arange(0, B)[:, None]
        valid = items < count
        items = tl.minimum(items, count - 1).to(tl.int64)  # the last block repeats the last splat, and keeps it back
        rows = tl.load(visible + items)
        Z = load_latents(latents, rows, D, P, B)
        d, log_r, _, _ = _view(means, centers, rows, items, lanes, eps_squared, log_unit, B, ONE_CENTER)
        stored = load_four(features_dc, opacities, rows, rows >= 0, lanes, B)

        base = base_appearance(stored, lanes, sh_c0)
        F = _features(d, base, log_r, _waves(d, BANDS), lanes, B, P // 4, BANDS)
        pre = dot(_inputs(Z, F, B, P, KIND), W1, tl.zeros((B, H), tl.float32), KIND)
        hidden = operand(tl.maximum(pre, 0.0, propagate_nan=tl.PropagateNan.ALL), KIND)
        Y = dot(hidden, W2, tl.zeros((B, COLUMNS), tl.float32), KIND) + b2[None, :]
        _, _, argument = _outputs(Y, lanes, B, COLUMNS)
        t = tanh(argument)

        color = tl.maximum(base + color_scale * t, 0.0, propagate_nan=tl.PropagateNan.ALL)
        opacity, _, _ = _bounded_opacity(stored, base, t, opacity_scale, BOUND)
        out = deal(tl.where(lanes < 3, color, opacity), B)
        tl.store(colors_out + items * 3 + lanes, out, mask=valid & (lanes < 3))
        tl.store(opacities_out + items + (lanes - 3), out, mask=valid & (lanes == 3))


@triton.jit(do_not_specialize=["count"])
def backward_kernel(
    means, latents, features_dc, opacities, visible, centers, packed,
    d_colors, d_opacities,
    d_means, d_latents, d_features_dc, d_logits, d_centers, partials,
    count, eps_squared, log_unit, color_scale, opacity_scale, sh_c0,
    D: tl.constexpr, P: tl.constexpr, H: tl.constexpr, BANDS: tl.constexpr, B: tl.constexpr, COLUMNS: tl.constexpr,
    SLOTS: tl.constexpr, ONE_CENTER: tl.constexpr, BOUND: tl.constexpr, CENTER: tl.constexpr,
    KIND: tl.constexpr, GRADIENT_KIND: tl.constexpr,
):  # fmt: skip
    """Gradients of everything, from those of colours and opacities; d_x is the loss's derivative by x.

    Rows of the tables' gradients that no block visits are not written. Each program writes its sum of the packed
    weights' gradients, and of one shared camera centre's, to its row of `partials` [programs, SLOTS]: no atomics, so
    the result is the same every time.
    """
    lanes = tl.arange(0, 4)[None, :]
    outputs = tl.arange(0, COLUMNS)
    sixteen = tl.arange(0, 16)
    units = tl.arange(0, H)
    inputs = tl.arange(0, 2 * P)
    layer2 = packed + 2 * P * H
    real = outputs < OUTPUTS
    weights1 = tl.load(packed + inputs[:, None] * H + units[None, :])
    W1 = operand(weights1, KIND)
    W1_T = tl.trans(operand(weights1, GRADIENT_KIND))
    W2 = tl.load(layer2 + units[:, None] * OUTPUTS + outputs[None, :], mask=real[None, :], other=0.0)
    W2 = operand(W2, KIND)
    W2_T = tl.load(layer2 + units[:, None] * OUTPUTS + sixteen[None, :], mask=sixteen[None, :] < OUTPUTS, other=0.0)
    W2_T = tl.trans(operand(W2_T, GRADIENT_KIND))
    b2 = tl.load(layer2 + H * OUTPUTS + outputs, mask=real, other=0.0)
    if COLUMNS == 8:
        d_W1 = tl.zeros((H, 2 * P), tl.float32)
    else:
        d_W1 = tl.zeros((2 * P, H), tl.float32)
    d_W2 = tl.zeros((H, COLUMNS), tl.float32)
    d_b2_low, d_b2_high = tl.zeros((B, 4), tl.float32), tl.zeros((B, 4), tl.float32)
    d_center = tl.zeros((B, 4), tl.float32)

    for block in tl.range(tl.program_id(0), tl.cdiv(count, B), tl.num_programs(0), disable_licm=True):
        items = block * B + tl.arange(0, B)[:, None]
        valid = items < count
        items = tl.minimum(items, count - 1).to(tl.int64)  # the last block repeats the last splat, and keeps it back
        rows = tl.load(visible + items)
        Z = load_latents(latents, rows, D, P, B)
        d, log_r, inv_r, above_floor = _view(means, centers, rows, items, lanes, eps_squared, log_unit, B, ONE_CENTER)
        stored = load_four(features_dc, opacities, rows, rows >= 0, lanes, B)
        d_out = load_four(d_colors, d_opacities, items, valid, lanes, B)

        # Forward again.
        base = base_appearance(stored, lanes, sh_c0)
        waves = _waves(d, BANDS)
        F = _features(d, base, log_r, waves, lanes, B, P // 4, BANDS)
        X = _inputs(Z, F, B, P, KIND)
        pre = tl.maximum(dot(X, W1, tl.zeros((B, H), tl.float32), KIND), 0.0, propagate_nan=tl.PropagateNan.ALL)
        hidden = operand(pre, KIND)
        Y = dot(hidden, W2, tl.zeros((B, COLUMNS), tl.float32), KIND) + b2[None, :]
        if KIND != GRADIENT_KIND:
            X = _inputs(Z, F, B, P, GRADIENT_KIND)
            hidden = operand(pre, GRADIENT_KIND)
        high, gate, argument = _outputs(Y, lanes, B, COLUMNS)
        t = tanh(argument)

        # Outputs.
        d_color = tl.where(base + color_scale * t >= 0.0, d_out, 0.0)
        _, logit_slope, t_slope = _bounded_opacity(stored, base, t, opacity_scale, BOUND)
        d_low = tl.where(lanes < 3, color_scale * d_color, d_out * t_slope) * (1.0 - t * t)
        d_gate = gate * (1.0 - gate) * tl.sum(tl.where(lanes < 3, d_low * high, 0.0), axis=1)[:, None]
        d_high = tl.where(lanes < 3, gate * d_low, d_gate)
        d_b2_low += d_low
        d_b2_high += d_high

        # Layers. Which units are on is read from the rounded activations: kept apart, it costs the registers or the
        # instructions of a mask.
        d_Y = operand(tl.reshape(tl.join(d_low, d_high), (B, 8)), GRADIENT_KIND)
        d_Y16 = _padded(d_Y, B)
        d_hidden = dot(d_Y16, W2_T, tl.zeros((B, H), tl.float32), GRADIENT_KIND)
        d_W2 = dot(tl.trans(hidden), d_Y if COLUMNS == 8 else d_Y16, d_W2, GRADIENT_KIND)
        d_pre = operand(tl.where(hidden > 0.0, d_hidden, 0.0), GRADIENT_KIND)
        d_X = dot(d_pre, W1_T, tl.zeros((B, 2 * P), tl.float32), GRADIENT_KIND)
        if COLUMNS == 8:
            d_W1 = dot(tl.trans(d_pre), X, d_W1, GRADIENT_KIND)
        else:
            d_W1 = dot(tl.trans(X), d_pre, d_W1, GRADIENT_KIND)
        d_Z, d_F = tl.split(tl.reshape(d_X, (B, P, 2)))
        store_latents(d_latents, rows, d_Z, valid, D, P, B, ONE_CENTER)

        # Features.
        d_view, d_base = _features_backward(d_F, waves, lanes, B, P // 4, BANDS)
        d_stored = tl.where(lanes < 3, sh_c0 * (d_base + d_color), d_out * logit_slope + d_base * base * (1.0 - base))
        d_stored = deal(d_stored, B)
        store_gradients(d_features_dc + rows * 3 + lanes, d_stored, valid & (lanes < 3), ONE_CENTER)
        store_gradients(d_logits + rows + (lanes - 3), d_stored, valid & (lanes == 3), ONE_CENTER)

        # Geometry: d = v / r and log r, where r is floored and has no slope below the floor.
        radial = tl.sum(tl.where(lanes < 3, -d_view * d, d_view), axis=1)[:, None]
        radial = tl.where(above_floor, radial, 0.0)
        d_v = inv_r * (d_view + radial * d)
        mask = valid & (lanes < 3)
        store_gradients(d_means + rows * 3 + lanes, deal(-d_v, B), mask, ONE_CENTER)
        if CENTER and ONE_CENTER:
            d_center += d_v  # 0 beyond `count`, where d_out is
        if CENTER and not ONE_CENTER:
            tl.store(d_centers + items * 3 + lanes, deal(d_v, B), mask=mask)

    partial = partials + tl.program_id(0) * SLOTS
    layer2 = partial + 2 * P * H
    if COLUMNS == 8:
        tl.store(partial + inputs[None, :] * H + units[:, None], d_W1)
    else:
        tl.store(partial + inputs[:, None] * H + units[None, :], d_W1)
    tl.store(layer2 + units[:, None] * OUTPUTS + outputs[None, :], d_W2, mask=real[None, :])
    d_b2 = tl.sum(tl.reshape(tl.join(d_b2_low, d_b2_high), (B, 8)), axis=0)
    tl.store(layer2 + H * OUTPUTS + tl.arange(0, 8), d_b2)
    tl.store(layer2 + H * OUTPUTS + OUTPUTS + tl.arange(0, 4), tl.sum(d_center, axis=0))
