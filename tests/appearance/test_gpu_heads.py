# SPDX-License-Identifier: Apache-2.0
"""The fused field on a CUDA device against PyTorch's in float64. `pytest -m gpu`."""

import pytest
import torch
from fused_cases import assert_near, compare, evaluate, float32_tolerance, heads, rounding, scene

from nrfgs_ns.appearance.nrf import NrfConfig

pytestmark = pytest.mark.gpu

# The card's own exp, log, sqrt and division are good to 2 ULP or so each, and its three tf32 products leave 2^-21 of a
# product instead of 2^-24: eight times the float32 that the interpreter computes.
DEVICE_FLOAT32 = 8.0


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("opacity_bound", ["straight-through", "logit"])
@pytest.mark.parametrize("visible", [0, 1, 65, 5000])
def test_values_and_gradients(opacity_bound, visible, repeated):
    head, twin = heads("cuda", opacity_bound=opacity_bound)
    compare(head, twin, scene(head, 6000, visible, repeated), DEVICE_FLOAT32 * float32_tolerance())


def compare_rounded(head, twin, precision, case):
    """Hold the kernels against the twin that rounds as they do.

    Values: derivation in fused_interpreted.py; the card's float32 is coarser, so four times as many factors differ.

    Gradients: where a factor is rounded up by one and down by the other, a hidden unit near zero may be on in one and
    off in the other, and its whole gradient comes or goes. One in 2^9 features of tf32 is 2^-10 off, which moves the
    sum before the ReLU by some 2^-10 sqrt(2^-9) / 2 = 2^-15.5 of its own size. About as many units change sides, of
    half that are on: sqrt(2 * 2^-15.5) = 2^-7 of a gradient's norm if all features are as coarse, and most (the
    latents) are exact: 2^-8. Not rounding in the twin at all would leave 2^-6 (tf32) to 2^-4.6 (bf16).
    """
    from nrfgs_ns.appearance.fused.launch import KINDS

    exact = evaluate(rounding(twin, KINDS[precision]), *case, dtype=torch.float64)
    assert_near(evaluate(head, *case), exact, {name: 2.0**-8 if name.startswith("d ") else 2.0**-12 for name in exact})


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("precision", ["tf32", "bf16", "fp16"])
def test_rounded_products(precision, repeated):
    head, twin = heads("cuda", precision=precision)
    compare_rounded(head, twin, precision, scene(head, 120_000, 100_000, repeated))


@pytest.mark.parametrize("way", [0, 1])
@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("config", [
    {"num_bands": 1, "latent_dim": 1, "hidden_width": 5},
    {"num_bands": 2, "latent_dim": 7, "hidden_width": 20},
    {"num_bands": 5, "latent_dim": 33, "hidden_width": 64},
    {"num_bands": 7, "latent_dim": 64, "hidden_width": 30},
    {"hidden_width": 128},
    {"num_bands": 1, "latent_dim": 16, "hidden_width": 256, "split_bands": False},
    {"split_bands": False, "opacity_residual": False},
    {"opacity_bound": "logit", "use_distance": False},
])  # fmt: skip
def test_sizes_and_ways(config, repeated, way, monkeypatch):
    """Every size that the kernels take, launched in the first way and in the one for small cards."""
    from nrfgs_ns.appearance.fused import launch

    monkeypatch.setitem(launch.LAUNCHES, "bf16", launch.LAUNCHES["bf16"][way:])
    head, twin = heads("cuda", precision="bf16", **config)
    compare_rounded(head, twin, "bf16", scene(head, 6000, 5000, repeated))


@pytest.mark.parametrize("precision", ["fp32", "tf32", "bf16", "fp16"])
def test_extremes_stay_finite(precision):
    head, _ = heads("cuda", precision=precision, scale=100.0)
    splats, visible, centers = scene(head, 1000, 900)
    splats["latents"] *= 1e4
    splats["opacities"] = 1e4 * splats["opacities"].sign()
    centers.copy_(splats["means"][visible[0]])
    found = evaluate(head, splats, visible, centers)
    assert all(torch.isfinite(value).all() for value in found.values())
    assert ((found["opacities"] >= 0) & (found["opacities"] <= 1)).all() and (found["colors"] >= 0).all()


def test_lengths_are_in_scene_units():
    head, twin = heads("cuda")
    splats, visible, centers = scene(head, 3000, 2000)
    head.scene_unit = twin.scene_unit = 1024.0
    case = {**splats, "means": 1024.0 * splats["means"]}, visible, 1024.0 * centers
    compare(head, twin, case, DEVICE_FLOAT32 * float32_tolerance())


def test_auto_takes_the_kernels_and_falls_back():
    for config, taken in (({}, True), ({"latent_dim": 65}, False)):
        head = NrfConfig(**config).setup().cuda()
        case = scene(head, 100, 80)
        assert head.fused.takes(case[0]) == taken
        head(*case)


def test_rows_beyond_32_bit_offsets():
    """The last rows of a table of more than 2^31 latents: 9 GB, and as much again for the gradient."""
    count = 2**26 + 5
    if torch.cuda.mem_get_info()[0] < 30 * 2**30:
        pytest.skip("needs 30 GB of GPU memory")
    head, _ = heads("cuda")
    small, _, center = scene(head, 3, 3)
    rows = torch.arange(3, device="cuda")
    near = evaluate(head, small, rows, center)
    large = {name: torch.zeros(count, value.shape[1], device="cuda") for name, value in small.items()}
    for name, table in large.items():
        table[count - 3 :] = small[name]
        table.requires_grad_()
    colors, opacities = head(large, rows + count - 3, center)
    assert torch.equal(colors, near["colors"]) and torch.equal(opacities, near["opacities"])
    (colors.sum() + opacities.sum()).backward()
    assert all((table.grad[count - 3 :] != 0).any() for table in large.values())
    assert all((table.grad[: count - 3] == 0).all() for table in large.values())
