# SPDX-License-Identifier: Apache-2.0
"""What growth by gradients remembers, on a GPU. In Triton's interpreter: statistics_interpreted.py."""

import pytest
import torch

from nrfgs_ns.densification import statistics


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_one_camera_is_the_kernels(monkeypatch):
    torch.manual_seed(0)
    info = {
        "width": 640, "height": 480, "n_cameras": 1, "gaussian_ids": torch.randperm(5000, device="cuda")[:3000],
        "radii": torch.randint(1, 90, (3000,), dtype=torch.int32, device="cuda"),
    }  # fmt: skip
    state = {name: torch.zeros(5000, device="cuda") for name in ("grad2d", "count", "radii")}
    gradients = torch.randn(3000, 2, device="cuda")
    twin = {name: value.clone() for name, value in state.items()}
    statistics.add_in_torch(twin, info["gaussian_ids"], gradients, info["radii"], (320.0, 240.0), 640.0)
    monkeypatch.setattr(statistics, "add_in_torch", None)
    statistics.take_statistics(state, info, gradients)
    for name in state:
        torch.testing.assert_close(state[name], twin[name], rtol=1e-6, atol=0.0)
