# SPDX-License-Identifier: Apache-2.0
"""What growth by gradients remembers: the kernel (statistics_interpreted.py, in its own process) and its choice."""

import importlib.util
from pathlib import Path

import pytest
import torch
from interpreted import passes_in_the_interpreter

from nrfgs_ns.densification import statistics

INTERPRETED = Path(__file__).with_name("statistics_interpreted.py")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
def test_the_kernel_in_the_interpreter():
    passes_in_the_interpreter(INTERPRETED)


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
