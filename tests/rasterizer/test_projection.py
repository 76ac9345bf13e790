# SPDX-License-Identifier: Apache-2.0
"""Projection: which splats are visible, at the limits, and an independent implementation to compare with.

Values and gradients are held against the float64 twin in test_against_twin.py.
"""

import pytest
import torch
from make_gsplat_fixtures import CASES, _camera

from nrfgs_ns.rasterizer import ProjectionOptions, project

W, H = 40, 28
ANTIALIASED = ProjectionOptions("antialiased")


def one(z=2.0, x=0.0, y=0.0, scale=0.1, quat=(1.0, 0.0, 0.0, 0.0), **options):
    """The projection of one splat; `scale` is a number or a tensor [1, 3]."""
    scales = scale if isinstance(scale, torch.Tensor) else torch.full((1, 3), scale)
    splat = torch.tensor([[x, y, z]]), torch.tensor([quat]), scales
    return project(*splat, torch.eye(4)[None], _camera(W, H)[None], W, H, ProjectionOptions(**options))


@pytest.mark.parametrize(
    ("z", "seen"),
    [(-1.0, False), (0.0, False), (0.25 - 2**-26, False), (0.25, True), (4.0, True), (4.0 + 2**-21, False)],
)
def test_near_and_far_planes_are_inclusive(z, seen):
    assert len(one(z, near_plane=0.25, far_plane=4.0).radii) == seen


def test_square_must_overlap_the_image():
    """A point has radius 3. Its centre is at x = 20 + f / 2 times its offset at depth 2; it is seen if x + 3 > 0."""
    edge = -23 * 2 / float(_camera(W, H)[0, 0])
    assert len(one(x=edge * 1.001, scale=1e-6).radii) == 0
    assert one(x=edge * 0.999, scale=1e-6).radii.tolist() == [3]


def test_radius_of_a_point_comes_from_the_blur():
    """cov = 0.3 I: b^2 - det = 0 is floored at 0.1, so r = ceil(3 sqrt(0.3 + sqrt 0.1)) = ceil(2.355) = 3."""
    assert int(one(scale=1e-6).radii[0]) == 3


@pytest.mark.parametrize("field", ["means", "quats", "scales"])
def test_invisible_and_invalid_splats_send_no_nan_back(field):
    """Centres at and behind the camera, zero quaternions, infinite and NaN scales: invisible, gradient exactly 0."""
    means = torch.tensor([[0.0, 0.0, z] for z in (2.0, 0.0, -1.0, 2.0, 2.0, 2.0)])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(6, 1)
    scales = torch.full((6, 3), 0.1)
    quats[3], scales[4], scales[5] = 0.0, float("inf"), float("nan")
    tensors = {"means": means, "quats": quats, "scales": scales}
    leaf = tensors[field].requires_grad_()
    p = project(**tensors, viewmats=torch.eye(4)[None], Ks=_camera(W, H)[None], width=W, height=H, options=ANTIALIASED)
    assert p.gaussian_ids.tolist() == [0]
    (p.means2d.sum() + p.conics.sum() + p.depths.sum() + p.compensations.sum()).backward()
    assert torch.isfinite(leaf.grad).all() and (leaf.grad[1:] == 0).all()


def test_flat_splat_has_finite_gradients():
    """Seen edge on, a disc of thickness 0 has det = 0 and compensation 0: sqrt would send an infinity back."""
    scales = torch.tensor([[0.0, 0.1, 0.1]], requires_grad=True)
    p = one(scale=scales, rasterize_mode="antialiased")
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
        splats = [one.to(dtype, copy=True).requires_grad_() for one in (means, quats, scales)]
        camera = torch.eye(4, dtype=dtype)[None], _camera(W, H)[None].to(dtype)
        found = project(*splats, *camera, W, H, ANTIALIASED)
        found.compensations.sum().backward()
        return [one.grad.double() for one in splats]

    for ours, exact in zip(gradients(torch.float32), gradients(torch.float64), strict=True):
        assert (ours - exact).abs().max() <= 64 * 2**-24 * exact.abs().max()


def test_long_needles_keep_a_definite_conic():
    """Ten thousand pixels long, a third of a pixel wide: the covariance's determinant is 1e-9 of its products."""
    needle = one(z=1.0, scale=torch.tensor([[300.0, 1e-3, 1e-3]]), quat=(0.924, 0.0, 0.0, 0.383))
    a, b, c = needle.conics[0].double()
    # Across the needle only the blur is left: the conic's trace is 1 / 0.3 up to float32's 1e-7.
    assert abs(float(a + c) * (0.3 + (34.64e-3) ** 2) - 1) < 1e-4


def test_agrees_with_gsplats_torch_projection():
    """gsplat's own plain-torch projection, an independent program, in float64.

    Its radius formula differs from its kernel's (0.01 for 0.1 under the root) and its fov limit is symmetric: those are
    left to the recorded GPU results.
    """
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    case = CASES["ordinary"]()
    tensors = [t.double() for t in (case.means, case.quats, case.scales, case.viewmats, case.Ks)]
    quats = tensors[1] / tensors[1].norm(dim=-1, keepdim=True)
    covars, _ = torch_impl._quat_scale_to_covar_preci(quats, tensors[2], True, False)
    size = (case.width, case.height)
    _, means2d, depths, conics, compensations = torch_impl._fully_fused_projection(
        tensors[0], covars, *tensors[3:], *size, calc_compensations=True
    )
    p = project(*tensors, *size, ANTIALIASED)
    theirs = {"means2d": means2d, "depths": depths, "conics": conics, "compensations": compensations}
    for name, table in theirs.items():
        torch.testing.assert_close(getattr(p, name), table[0, p.gaussian_ids], rtol=1e-9, atol=1e-12)


def test_rows_are_ordered_by_camera_then_splat():
    case = CASES["several_cameras"]()
    p = project(case.means, case.quats, case.scales, case.viewmats, case.Ks, case.width, case.height)
    key = p.camera_ids * len(case.means) + p.gaussian_ids
    assert torch.equal(key, key.sort().values) and len(key.unique()) == len(key)
    assert p.camera_ids.dtype == p.gaussian_ids.dtype == torch.int64 and p.radii.dtype == torch.int32
