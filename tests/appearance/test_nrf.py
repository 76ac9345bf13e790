# SPDX-License-Identifier: Apache-2.0
import math
from unittest.mock import Mock

import pytest
import torch
from fused_cases import heads
from fused_cases import scene as fused_scene
from head_cases import awake, scene
from torch.testing import assert_close

from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.nrf import NrfConfig, bounded_opacity
from nrfgs_ns.appearance.sh import ShConfig


def by_hand(head, splats, visible, centers):
    """The paper's formulas, one splat at a time, with nothing shared with the implementation but the weights."""
    low, high = head.low, head.high

    def layer(net, x):
        return net[2].weight @ torch.relu(net[0].weight @ x + net[0].bias) + net[2].bias

    colors, opacities = [], []
    for row, center in zip(visible.tolist(), centers, strict=True):
        v = center - splats["means"][row]
        r = v.norm().reshape(1)
        d = v / r
        c, z = 0.5 + SH_C0 * splats["features_dc"][row], splats["latents"][row]
        alpha = 1 / (1 + torch.exp(-splats["opacities"][row]))
        low_d = torch.cat([d, torch.sin(math.pi * d), torch.cos(math.pi * d)])
        high_d = torch.cat([f(2.0**k * math.pi * d) for k in (1, 2) for f in (torch.sin, torch.cos)])
        a = layer(low, torch.cat([z, c, r.log(), alpha, low_d]))
        b = layer(high, torch.cat([z, c, r.log(), high_d]))
        colors.append((c + 0.2 * torch.tanh(a[:3] + b[:3] / (1 + torch.exp(-b[3])))).clamp_min(0))
        opacities.append((alpha + 0.2 * torch.tanh(a[3:])).clamp(0, 1))
    return torch.stack(colors), torch.cat(opacities)


@pytest.mark.parametrize("split_bands, count", [(True, 6664), (False, 8068)])
def test_paper_counts(split_bands, count):
    assert sum(weights.numel() for weights in NrfConfig(split_bands=split_bands).setup().parameters()) == count


def test_matches_the_formulas():
    head = awake(NrfConfig())
    colors, opacities = head(*scene(head))
    expected_colors, expected_opacities = by_hand(head, *scene(head))
    assert_close(colors, expected_colors)
    assert_close(opacities, expected_opacities)


@pytest.mark.parametrize("split_bands", [True, False])
@pytest.mark.parametrize("opacity_residual", [True, False])
@pytest.mark.parametrize("use_distance", [True, False])
@pytest.mark.parametrize("num_bands", [1, 2, 5])
def test_every_switch_builds_and_is_felt(split_bands, opacity_residual, use_distance, num_bands):
    switches = {"split_bands": split_bands, "opacity_residual": opacity_residual, "use_distance": use_distance}
    head = awake(NrfConfig(**switches, num_bands=num_bands, latent_dim=7, hidden_width=16))
    splats, visible, centers = scene(head)
    colors, opacities = head(splats, visible, centers)
    assert (head.high is not None) == (split_bands and num_bands > 1)

    base = head.base_appearance(splats, visible)
    assert ((colors - base.colors).abs() <= 0.2 + 1e-12).all()
    assert torch.equal(opacities, base.opacities) == (not opacity_residual)
    # Twice as far in the same direction changes something exactly if distance is seen.
    means = splats["means"].index_select(0, visible)
    further = head(splats, visible, means + 2 * (centers - means)).colors
    assert torch.allclose(further, colors, atol=1e-12) == (not use_distance)


def test_straight_through_is_a_clamp_whose_gradient_ignores_it_and_logit_the_residual_at_half_opacity():
    logit = torch.tensor([[-3.0], [0.0], [3.0]], dtype=torch.double)
    residual = torch.tensor([[-1.0], [0.5], [1.0]], dtype=torch.double, requires_grad=True)
    opacity = bounded_opacity(logit, residual, 0.2, "straight-through")
    assert_close(opacity.detach().squeeze(), torch.tensor([0.0, 0.6, 1.0], dtype=torch.double))
    opacity.sum().backward()
    assert residual.grad.squeeze().tolist() == [0.2, 0.2, 0.2]
    residual = torch.tensor([[1e-4]], dtype=torch.double)
    opacity = bounded_opacity(torch.zeros(1, 1, dtype=torch.double), residual, 0.2, "logit")
    # The sigmoid has no second derivative at 0; the third leaves (4 * 0.2e-4)^3 / 48.
    assert_close(opacity.item() - 0.5, 0.2e-4, rtol=0, atol=2e-14)


@pytest.mark.parametrize(
    "field, value", [("num_bands", 0), ("latent_dim", 0), ("color_scale", -0.1), ("precision", "fp8"), ("degree", 4)]
)
def test_impossible_settings_are_named(field, value):
    with pytest.raises(ValueError, match=f"appearance.{field} is {value!r}"):
        (ShConfig if field == "degree" else NrfConfig)(**{field: value}).setup()


# When the fused kernels are chosen; fused_interpreted.py tests them.
@pytest.mark.parametrize("sizes", [{"latent_dim": 65}, {"hidden_width": 129}, {"hidden_width": 65, "num_bands": 5}])
def test_sizes_beyond_the_kernels_are_named(sizes, caplog):
    head, _ = heads(**sizes)
    assert head.fused.prepared_on(torch.device("cpu")) is None
    assert "The field is slower on cpu" in caplog.text and "its sizes are beyond the kernels'" in caplog.text


def test_pytorch_computes_on_a_cpu_and_what_is_not_float32():
    splats, _, _ = fused_scene(heads()[0], 20, 15)
    head = NrfConfig(implementation="fused").setup()  # in a configuration that 0.2.0 has saved
    assert not head.fused.takes(splats)
    on_gpu = {name: Mock(device=torch.device("cuda"), dtype=torch.float32) for name in splats}
    head.fused.prepared_on = lambda device: "prepared"
    assert head.fused.takes(on_gpu)
    assert not head.fused.takes({**on_gpu, "latents": Mock(dtype=torch.float64)})
    head.config.implementation = "torch"
    assert not head.fused.takes(on_gpu)
