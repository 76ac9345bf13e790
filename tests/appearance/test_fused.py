# SPDX-License-Identifier: Apache-2.0
"""When the fused field is chosen. Its kernels: fused_interpreted.py."""

import pytest
import torch
from fused_cases import heads, scene

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
