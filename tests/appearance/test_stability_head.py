# SPDX-License-Identifier: Apache-2.0
"""Extremes of everything between a splat's numbers and its colour and opacity: the torch heads, in float32."""

import math
from typing import NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.appearance.nrf import FARTHEST, OPACITY_BOUNDS, NrfConfig, bounded_opacity, fourier_bands, view_geometry
from nrfgs_ns.appearance.sh import ShConfig

U = 2.0**-24
"""Rounding unit of float32."""
HEADS = {
    "nrf": NrfConfig(output_init="default", implementation="torch"),
    "nrf, one branch": NrfConfig(output_init="default", implementation="torch", split_bands=False),
    "nrf, six bands": NrfConfig(output_init="default", implementation="torch", num_bands=6),
    "nrf, logit": NrfConfig(output_init="default", implementation="torch", opacity_bound="logit"),
    "sh": ShConfig(degree_interval=1),
}


class Extreme(NamedTuple):
    """What is extreme about the splats of a test."""

    distance: float = 2.0
    coordinate: float = 1.0
    logit: float = 0.0
    latent: float = 0.1
    weight: float = 1.0
    color: float = 0.3


def build(head_name: str, extreme: Extreme, count: int = 6, seed: int = 0):
    """A head and `count` splats around the point (coordinate, ...), seen from `distance` away; all float32 leaves."""
    torch.manual_seed(seed)
    head = HEADS[head_name].setup()
    head.set_step(10**6)
    with torch.no_grad():
        for weights in head.parameters():
            weights *= extreme.weight
    splats = head.splat_params(torch.rand(count, 3))
    for name in splats.keys() & {"latents", "features_rest"}:
        splats[name] = torch.randn_like(splats[name]) * extreme.latent
    splats["features_dc"] = torch.randn(count, 3) * extreme.color
    center = torch.randn(3) * extreme.coordinate
    splats["means"] = center + torch.nn.functional.normalize(torch.randn(count, 3)) * extreme.distance
    splats["opacities"] = torch.full((count, 1), extreme.logit)
    return head, {name: value.requires_grad_() for name, value in splats.items()}, center.requires_grad_()


def assert_healthy(head, splats, center, rows=None):
    """Finite values in their ranges, and finite gradients of a loss that weighs them all."""
    colors, opacities = head(splats, torch.arange(len(splats["means"])) if rows is None else rows, center)
    assert torch.isfinite(colors).all() and (colors >= 0).all()
    assert torch.isfinite(opacities).all() and (opacities >= 0).all() and (opacities <= 1).all()
    (colors.sum() + opacities.sum()).backward()
    for name, value in [*splats.items(), ("camera", center), *head.named_parameters()]:
        assert value.grad is None or torch.isfinite(value.grad).all(), name
    return colors.detach(), opacities.detach()


@pytest.mark.parametrize("head", HEADS)
@settings(max_examples=12, derandomize=True)
@given(exponent=st.floats(-30, 30), seed=st.integers(0, 99))
def test_distances_from_1e_30_to_1e30(head, exponent, seed):
    head, splats, center = build(head, Extreme(distance=10.0**exponent, coordinate=0.0), seed=seed)
    assert_healthy(head, splats, center)


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("extreme", [
    *(Extreme(coordinate=at, distance=distance) for at in (1e-6, 1e6) for distance in (1e-6, 1.0, 1e6)),
    *(Extreme(latent=size) for size in (1e4, 1e10, 1e20)),
    *(Extreme(color=color) for color in (-1e18, 1e4, 1e18)),
])  # fmt: skip
def test_coordinates_latents_and_base_colours(head, extreme):
    """At 1e6, float32 sees positions on a grid of 1/16: splats closer than that are on the camera, and no harm done."""
    assert_healthy(*build(head, extreme))


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("logit", [-math.inf, -1e4, -104.0, -88.0, -17.0, 17.0, 88.0, 104.0, 1e4, math.inf])
def test_opacity_logits_to_both_ends(head, logit):
    """Infinite logits are opacities of exactly 0 and 1."""
    head, splats, center = build(head, Extreme(logit=logit))
    assert_healthy(head, splats, center)
    base = head.base_appearance(splats, torch.arange(6)).opacities
    if logit <= -104:
        assert (base == 0).all()
    if logit >= 17:  # 1 - sigmoid(17) = 4.1e-8 is less than half the spacing below 1, which is 6e-8
        assert (base == 1).all()


@pytest.mark.parametrize("head", [head for head in HEADS if head.startswith("nrf")])
@settings(max_examples=12, derandomize=True)
@given(latent=st.floats(-3, 4), weight=st.floats(-3, 4), distance=st.floats(-18, 18), seed=st.integers(0, 99))
def test_latents_and_weights_together(head, latent, weight, distance, seed):
    """To 1e4 each, the largest sum is some 1e4 * 64 * (1e4 * 48 * 1e4) = 3e17, and gradients are 1e13 at most."""
    assert_healthy(*build(head, Extreme(latent=10.0**latent, weight=10.0**weight, distance=10.0**distance), seed=seed))


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("name", ["means", "features_dc", "opacities", "the head's own"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_splat_that_is_not_finite_harms_no_other(head, value, name):
    """Values of the others are to the bit what they are without it; gradients too, where the row is not asked for."""
    head, splats, center = build(head, Extreme())
    (own,) = splats.keys() & {"latents", "features_rest"}
    others, expected = torch.tensor([0, 1, 3, 4, 5]), head(splats, torch.arange(6), center)
    with torch.no_grad():
        splats[own if name == "the head's own" else name][2] = value
    got = head(splats, torch.arange(6), center)
    assert torch.equal(got.colors[others], expected.colors[others])
    assert torch.equal(got.opacities[others], expected.opacities[others])
    assert_healthy(head, splats, center, rows=others)


@given(st.floats(-1e4, 1e4, width=32), st.floats(-1e4, 1e4, width=32), st.floats(0, 1), st.sampled_from(OPACITY_BOUNDS))
def test_opacity_rises_with_its_logit(a, b, scale, bound):
    """For one and the same residual; and with finite gradients that are not negative by the residual."""
    logit = torch.tensor([[min(a, b)] * 5, [max(a, b)] * 5]).requires_grad_()
    residual = torch.tensor([-1.0, -0.3, 0.0, 0.3, 1.0]).expand(2, 5).clone().requires_grad_()
    opacity = bounded_opacity(logit, residual, scale, bound)
    assert (opacity[1] >= opacity[0]).all() and ((opacity >= 0) & (opacity <= 1)).all()
    opacity.sum().backward()
    assert torch.isfinite(logit.grad).all() and torch.isfinite(residual.grad).all() and (residual.grad >= 0).all()


@given(st.floats(-17, 17), st.floats(-17, 17), st.integers(0, 99))
def test_log_distance_rises_with_distance(a, b, seed):
    """Up to rounding: r is off by 4 roundings (difference, square and sum, root) and its logarithm by one more."""
    direction = torch.nn.functional.normalize(torch.randn(1, 3, generator=torch.Generator().manual_seed(seed)))
    near, far = (view_geometry(direction * 10.0**x, torch.zeros(3), 0.01)[1] for x in sorted((a, b)))
    assert far >= near - 6 * U - U * far.abs()
    assert near >= math.log(0.01) * (1 + 2 * U)


def test_beyond_the_farthest_nothing_moves_any_more():
    means = torch.tensor([[FARTHEST * 10, 0.0, 0.0], [3e38, 1e30, 3e38]], requires_grad=True)
    directions, log_distance = view_geometry(means, torch.full((3,), -3e38), 0.01)
    assert torch.isfinite(directions).all() and (directions.norm(dim=-1) <= 1 + 8 * U).all()
    (directions.sum() + log_distance.sum()).backward()
    assert (means.grad == 0).all()


@settings(max_examples=60, derandomize=True)
@given(st.floats(-18, 17), st.integers(0, 999))
def test_direction_distance_and_bands_agree_with_float64(exponent, seed):
    """Inputs of the field; the bounds are those of the next test."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(50, 3, generator=generator) * 10.0**exponent
    center = torch.randn(3, generator=generator) * 10.0**exponent
    d, log_r = view_geometry(means, center, 0.01)
    exact_d, exact_log_r = view_geometry(means.double(), center.double(), 0.01)
    assert ((d.double() - exact_d).abs() <= 8 * U).all()
    assert ((log_r.double() - exact_log_r).abs() <= 6 * U + U * exact_log_r.abs()).all()
    bands, exact_bands = (torch.cat(fourier_bands(x, 6), dim=1)[:, 3:] for x in (d, exact_d))
    for k in range(6):
        assert ((bands.double() - exact_bands)[:, 6 * k : 6 * k + 6].abs() <= 2.0**k * math.pi * 10 * U + 2 * U).all()


@settings(max_examples=60, derandomize=True)
@given(
    latent=st.floats(-3, 4),
    weight=st.floats(-2, 2),
    distance=st.floats(-18, 17),
    logit=st.floats(-1e4, 1e4),
    color=st.floats(-3, 4),
    seed=st.integers(0, 999),
)
def test_the_field_agrees_with_float64(latent, weight, distance, logit, color, seed):
    """|float32 - float64| under a bound that follows the arithmetic through both layers, input by input.

    Inputs. v is one rounding off, r and d = v / r four more: 8 u bounds d. A band's angle 2^k pi d is off by 2^k pi
    times that and by two roundings of its own, and sin and cos by 2 u: 2^k pi 10 u + 2 u. log r: 6 u + u |log r|.
    The colour 1/2 + c0 f: 2 u (1/2 + |c0 f|). alpha: 4 u. The latents are exact.

    Layers. A sum of n products and a bias is off by (n + 1) u times the sum of absolute values, in whatever order it
    is taken; errors of its inputs pass through |W|. ReLU does not amplify. dc_low + sigmoid(w) dc_high is off by
    e_low + e_high + |dc_high| (e_w / 4 + 2 u) + 2 u of its value. tanh's slope is at most 1; s_c scales; and sum and
    result round once each, with 4 u of the base for its own error.
    """
    sizes = {"latent": latent, "weight": weight, "distance": distance, "color": color}
    extreme = Extreme(**{name: 10.0**size for name, size in sizes.items()}, logit=logit, coordinate=0.0)
    head, splats, center = build("nrf", extreme, seed=seed)
    rows = torch.arange(6)
    with torch.no_grad():
        got = head(splats, rows, center)
        double = {name: value.double() for name, value in splats.items()}
        exact = head.double()(double, rows, center.double())

        directions, log_r = view_geometry(double["means"], center.double(), head.config.distance_eps)
        low, high = fourier_bands(directions, 3)
        c = 0.5 + 0.28209479177387814 * double["features_dc"]
        alpha = torch.sigmoid(double["opacities"])
        z = double["latents"]

        def band(k: int):
            return torch.full((6, 6), 2.0**k * math.pi * 10 * U + 2 * U, dtype=torch.float64)

        shared = [(z, 0 * z), (c, 2 * U * (0.5 + (c - 0.5).abs())), (log_r, 6 * U + U * log_r.abs())]
        e_low = torch.cat([torch.full((6, 3), 8 * U, dtype=torch.float64), band(0)], 1)
        out, e_out = layers(head.low, [*shared, (alpha, 4 * U + 0 * alpha), (low, e_low)])
        detail, e_detail = layers(head.high, [*shared, (high, torch.cat([band(1), band(2)], 1))])
        dc = out[:, :3] + torch.sigmoid(detail[:, 3:]) * detail[:, :3]
        e_dc = e_out[:, :3] + e_detail[:, :3] + detail[:, :3].abs() * (e_detail[:, 3:] / 4 + 2 * U) + 2 * U * dc.abs()
        tolerance = 0.2 * e_dc.clamp(max=2.0) + 4 * U * (0.5 + c.abs())
        assert ((got.colors.double() - exact.colors).abs() <= tolerance).all()
        assert ((got.opacities.double() - exact.opacities).abs() <= 0.2 * e_out[:, 3].clamp(max=2.0) + 8 * U).all()


def layers(net, inputs):
    """Value and error bound [M, out] of a two-layer network in float32, for inputs with error bounds; in float64."""
    x, e = (torch.cat(parts, dim=1) for parts in zip(*inputs, strict=True))
    for i, layer in enumerate((net[0], net[2])):
        W, b = layer.weight.double(), layer.bias.double()
        e = (W.shape[1] + 1) * U * (x.abs() @ W.abs().T + b.abs()) + e @ W.abs().T * (1 + 60 * U)
        x = x @ W.T + b
        x = x.relu() if i == 0 else x
    return x, e
