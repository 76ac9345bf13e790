# SPDX-License-Identifier: Apache-2.0
"""When the fused field is chosen. Its kernels: fused_interpreted.py."""

import pytest
import torch
from fused_cases import heads, scene

from nrfgs_ns.appearance.fused.packing import pack
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.errors import InputError


def test_cpu_takes_torch(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    head = NrfConfig().setup()
    splats, _, _ = scene(head, 20, 15)
    assert not head.fused.takes(splats)


@pytest.mark.parametrize(
    "interpreted, dtype, sizes, reason",
    [
        ("0", torch.float32, {}, "the splats are on cpu"),
        ("1", torch.float64, {}, "the splats are not float32"),
        *(
            ("1", torch.float32, sizes, "its sizes are beyond the kernels'")
            for sizes in ({"latent_dim": 65}, {"hidden_width": 129}, {"hidden_width": 65, "num_bands": 5})
        ),
    ],
)
def test_demanding_the_impossible_names_the_reason(interpreted, dtype, sizes, reason, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", interpreted)
    head, _ = heads(**sizes)
    splats, visible, centers = scene(head, 20, 15)
    with pytest.raises(InputError, match=f"implementation is 'fused', but {reason}.*auto or torch"):
        head({**splats, "latents": splats["latents"].to(dtype)}, visible, centers)


@pytest.mark.parametrize("config", [{}, {"split_bands": False}, {"num_bands": 1}, {"num_bands": 5, "latent_dim": 7}])
def test_packing_places_every_weight_once(config):
    head = NrfConfig(**config).setup()
    branches = [branch for branch in (head.low, head.high) if branch is not None]
    layout = pack(head.config.latent_dim, head.config.num_bands, head.config.use_distance, branches)
    weights = sum(parameter.numel() for parameter in head.parameters())
    positions, counts = layout.gather.unique(return_counts=True)
    assert torch.equal(positions[:weights], torch.arange(weights)) and (counts[:weights] == 1).all()
    assert torch.equal(layout.gather[layout.scatter], torch.arange(weights))
