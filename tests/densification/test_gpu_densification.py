# SPDX-License-Identifier: Apache-2.0
"""The moves of MCMC in torch, against gsplat's own with its CUDA kernels."""

import pytest
import torch
from torch.nn import Parameter
from torch.testing import assert_close

from nrfgs_ns.densification import statistics
from nrfgs_ns.densification.mcmc import add_noise, split_evenly
from nrfgs_ns.densification.statistics import Statistics

pytestmark = pytest.mark.gpu


def test_split_evenly_is_gsplats_relocation():
    """gsplat adds up to 51 alternating terms in float32. At n <= 10 and o <= 0.9 their size is at most 30 times the
    sum's (o' <= 0.9 / 4, (1 + o')^n < 8, divided by o' n / 3), so 55 terms lose at most 1e-4 of it."""
    from gsplat.relocation import compute_relocation
    from gsplat.strategy import MCMCStrategy

    torch.manual_seed(0)
    opacities = torch.empty(1000, device="cuda").uniform_(0.01, 0.9)
    scales = torch.empty(1000, 3, device="cuda").uniform_(0.001, 1.0)
    copies = torch.randint(1, 11, (1000,), device="cuda")
    theirs = compute_relocation(opacities, scales, copies.clone(), MCMCStrategy().initialize_state()["binoms"].cuda())
    ours = split_evenly(opacities, scales, copies)
    assert_close(ours[0], theirs[0], rtol=1e-4, atol=0)
    assert_close(ours[1], theirs[1], rtol=1e-4, atol=0)


def test_diffuse_is_gsplats_noise():
    from gsplat.strategy.ops import inject_noise_to_position

    torch.manual_seed(0)
    count = 1000
    start = {
        "means": torch.zeros(count, 3),
        "quats": torch.randn(count, 4),
        "scales": torch.randn(count, 3),
        "opacities": torch.empty(count, 1).uniform_(-7.0, -4.0),
    }
    results = []
    for move in (
        lambda splats: add_noise(splats, 0.1, torch.sigmoid(splats["opacities"].flatten())),
        lambda splats: inject_noise_to_position(splats, {}, {}, scaler=0.1),
    ):
        splats = {name: Parameter(value.cuda()) for name, value in start.items()}
        torch.manual_seed(1)
        with torch.no_grad():
            move(splats)
        results.append(splats["means"].detach())
    # Sums of nine products in float32, in another order: 1e-6 of the largest.
    assert_close(results[0], results[1], rtol=1e-4, atol=1e-6 * results[1].abs().max().item())


@pytest.mark.parametrize("counts", [True, False])
def test_one_camera_is_the_kernels(monkeypatch, counts):
    """Of 3000 of 5000 splats, some of them of no size."""
    torch.manual_seed(0)
    rows = torch.randperm(5000, device="cuda")[:3000]
    radii = torch.randint(0, 90, (3000,), dtype=torch.int32, device="cuda")
    info = {"width": 640, "height": 480, "n_cameras": 1, "gaussian_ids": rows, "radii": radii}
    tables = Statistics(*torch.zeros(3 if counts else 2, 5000, device="cuda"))
    gradients = torch.randn(3000, 2, device="cuda")
    twin = Statistics(*(None if value is None else value.clone() for value in tables))
    statistics.in_torch(twin, info, (640.0, 480.0), gradients)
    monkeypatch.setattr(statistics, "in_torch", None)
    statistics.accumulate(tables, info, 1.0, gradients)
    for value, other in zip(filter(torch.is_tensor, tables), filter(torch.is_tensor, twin), strict=True):
        torch.testing.assert_close(value, other, rtol=1e-6, atol=0.0)
