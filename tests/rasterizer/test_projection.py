# SPDX-License-Identifier: Apache-2.0
"""Projection: extreme gradients, the order of rows, and an independent implementation.

Values, gradients and visibility are compared with the float64 twin in test_against_twin.py.
"""

import pytest
import torch
from make_gsplat_fixtures import CASES, _camera

from nrfgs_ns.rasterizer import ProjectionOptions, project

W, H = 40, 28
ANTIALIASED = ProjectionOptions("antialiased")


def test_flat_splat_has_finite_gradients():
    """Seen edge on, a disc of thickness 0 has det = 0 and compensation 0: sqrt would send an infinity back."""
    scales = torch.tensor([[0.0, 0.1, 0.1]], requires_grad=True)
    splat = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), scales
    p = project(*splat, torch.eye(4)[None], _camera(W, H)[None], W, H, ANTIALIASED)
    p.compensations.sum().backward()
    assert p.compensations.item() == 0 and torch.isfinite(scales.grad).all()


@pytest.mark.parametrize("near", [0.012, 0.1, 1.0])
def test_gradients_of_compensations_near_the_camera(near):
    """What the blur adds to the determinant of a large splat is below float32's rounding of either determinant.

    Each entry is a sum of some ten products: it may be off by 64 rounding units of the largest.
    """
    g = torch.Generator().manual_seed(0)
    depth = near * (1 + torch.rand(500, generator=g))
    means = torch.cat([0.3 * depth[:, None] * torch.randn(500, 2, generator=g), depth[:, None]], 1)
    quats, scales = torch.randn(500, 4, generator=g), torch.exp(0.5 * torch.randn(500, 3, generator=g))

    def gradients(dtype: torch.dtype) -> list[torch.Tensor]:
        splats = [table.to(dtype, copy=True).requires_grad_() for table in (means, quats, scales)]
        camera = torch.eye(4, dtype=dtype)[None], _camera(W, H)[None].to(dtype)
        project(*splats, *camera, W, H, ANTIALIASED).compensations.sum().backward()
        return [table.grad.double() for table in splats]

    for ours, exact in zip(gradients(torch.float32), gradients(torch.float64), strict=True):
        assert (ours - exact).abs().max() <= 64 * 2**-24 * exact.abs().max()


def test_rows_are_ordered_by_camera_then_splat():
    case = CASES["several_cameras"]()
    p = project(case.means, case.quats, case.scales, case.viewmats, case.Ks, case.width, case.height)
    key = p.camera_ids * len(case.means) + p.gaussian_ids
    assert torch.equal(key, key.sort().values) and len(key.unique()) == len(key)
    assert p.camera_ids.dtype == p.gaussian_ids.dtype == torch.int64 and p.radii.dtype == torch.int32
