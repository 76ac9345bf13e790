# SPDX-License-Identifier: Apache-2.0
"""When the fused field is chosen. Its kernels: fused_interpreted.py."""

import pytest
import torch
from fused_cases import heads, scene, some_diffuse

from nrfgs_ns.appearance.fused.packing import pack
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.errors import InputError


@pytest.fixture
def no_interpreter(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)


def test_cpu_takes_torch(no_interpreter):
    head = NrfConfig(output_init="default").setup()
    splats, visible, centers = scene(head, 20, 15)
    assert not head.fused.takes(splats, centers)
    head.config.implementation = "torch"
    expected = head(splats, visible, centers)
    head.config.implementation = "auto"
    assert torch.equal(head(splats, visible, centers).colors, expected.colors)


def test_demanding_the_impossible_names_the_reason(no_interpreter):
    head, _ = heads()
    with pytest.raises(InputError, match="implementation is 'fused', but the splats are on cpu.*auto or torch"):
        head(*scene(head, 20, 15))


@pytest.mark.parametrize(
    "name, dtype, message",
    [
        ("latents", torch.float64, "latents is float64, and the kernels take float32"),
        ("diffuse", torch.uint8, "diffuse is uint8, and the kernels take bool"),
    ],
)
def test_other_types_are_named(name, dtype, message, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    head, _ = heads()
    splats, visible, centers = some_diffuse(scene(head, 20, 15), 0.5, last=True)
    with pytest.raises(InputError, match=message):
        head({**splats, name: splats[name].to(dtype)}, visible, centers)


@pytest.mark.parametrize("sizes", [{"latent_dim": 65}, {"hidden_width": 129}, {"hidden_width": 65, "num_bands": 5}])
def test_sizes_beyond_the_kernels_are_named(sizes, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    head, _ = heads(**sizes)
    with pytest.raises(InputError, match="its sizes are beyond the kernels'"):
        head(*scene(head, 20, 15))


@pytest.mark.parametrize("config", [{}, {"split_bands": False}, {"num_bands": 1}, {"num_bands": 5, "latent_dim": 7}])
def test_packing_places_every_weight_once(config):
    head = NrfConfig(**config).setup()
    layout = pack(head.config.latent_dim, head.config.num_bands, head.config.use_distance, head.low, head.high)
    weights = sum(parameter.numel() for parameter in head.parameters())
    positions, counts = layout.gather.unique(return_counts=True)
    assert torch.equal(positions[:weights], torch.arange(weights)) and (counts[:weights] == 1).all()
    assert torch.equal(layout.gather[layout.scatter], torch.arange(weights))
