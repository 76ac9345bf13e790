# SPDX-License-Identifier: Apache-2.0
"""The fast path, gsplat's recorded results and the float64 twin: any two agree up to rounding, in values, gradients
and absgrad, over the hard cases and over random scenes."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from agreement import BOUNDS, FLOAT32, FLOAT64, assert_agrees, devices, judge
from gsplat_call import draw_with_our_kernels, for_our_kernels, rasterization
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from make_gsplat_fixtures import CASES, Case, _camera, _cloud, evaluate, load, upstream

from nrfgs_ns.rasterizer import ProjectionOptions, contributions, project
from nrfgs_ns.rasterizer.torch_cpu import compositing, projection, tiles


def check(case: Case, dtype: torch.dtype = torch.float32, **limits) -> None:
    unit = {torch.float32: FLOAT32, torch.float64: FLOAT64}[dtype]
    options = {k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in case.options.items()}
    tensors = {k: v.to(dtype) for k, v in vars(case).items() if isinstance(v, torch.Tensor)}
    case = replace(case, **tensors, options=options)
    grads = upstream(case, **limits)
    ours = evaluate(rasterization, case, tuple(g.to(dtype) for g in grads), "cpu")
    assert_agrees(judge(case, grads, unit, **limits), ours, unit)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", CASES)
def test_hard_cases(name, dtype):
    """In float64 the same formulas with 29 bits more: what differs would be a wrong formula, not rounding."""
    check(CASES[name](), dtype)


@devices
@pytest.mark.parametrize("name", CASES)
def test_contributions_to_hard_cases(name, device):
    """The twin's gradient of the image by a colour; within rounding of a cut-off a share is anything up to 1."""
    case = CASES[name]()
    projecting = ("near_plane", "far_plane", "rasterize_mode")
    case = replace(case, options={name: value for name, value in case.options.items() if name in projecting})
    upper, alphas = upstream(case, bounds=BOUNDS[device])  # 0 at such pixels, else +-1
    verdict = judge(case, (upper.abs(), torch.zeros_like(alphas)), bounds=BOUNDS[device])

    means, quats, scales, opacities, _, viewmats, Ks = (t.to(device) for t in case.arguments()[:-2])
    projection = project(means, quats, scales, viewmats, Ks, case.width, case.height, ProjectionOptions(**case.options))
    shares = contributions(projection, opacities[projection.gaussian_ids])
    assert not shares.requires_grad
    total = torch.zeros(len(viewmats), len(means), dtype=torch.float64)
    total[projection.camera_ids.cpu(), projection.gaussian_ids.cpu()] = shares.cpu().double()
    free = (upper[..., 0] == 0).sum(dim=(1, 2)).double()[:, None]
    expected, tolerance = (table["grad_colors"][..., 0] for table in (verdict.values, verdict.tolerances))
    if case.colors.dim() == 2:
        total, free = total.sum(dim=0), free.sum()
    assert ((total - expected).abs() <= tolerance + free).all()


@pytest.mark.parametrize("name", ["ordinary", "opaque_layers", "several_cameras"])
def test_any_partition_of_the_work_gives_the_same_result(name, monkeypatch):
    """Slabs of 5, batches of a few tiles and blocks of 100 pairs: every loop is taken, every state handed over."""
    monkeypatch.setattr(compositing, "SLAB", 5)
    monkeypatch.setattr(tiles, "BATCH_ELEMENTS", 64 * 13)
    monkeypatch.setattr(compositing, "BLOCK_PAIRS", 100)
    check(CASES[name]())


@pytest.mark.parametrize("offset", [0.0, 1e-3, 0.02])
def test_points_beside_pixel_centres(offset, monkeypatch):
    """A tile's corners, where what is linear and square in the pixel's place cancels most."""
    centres = torch.tensor([[0.5, 0.5], [7.5, 0.5], [0.5, 7.5], [7.5, 7.5]]) + offset
    case = Case(
        means=torch.cat([(centres - 4) / 5, torch.full((4, 1), 2.0)], 1),
        quats=torch.tensor([[1.0, 0.2, 0.3, 0.4]]).repeat(4, 1),
        scales=torch.tensor([[1e-4, 8e-5, 6e-5]]).repeat(4, 1),
        opacities=torch.full((4,), 0.5),
        colors=torch.tensor([[-0.9], [-0.2], [0.4], [1.1]]),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[10.0, 0.0, 4.0], [0.0, 10.0, 4.0], [0.0, 0.0, 1.0]]]),
        width=8,
        height=8,
    )
    monkeypatch.setattr(projection, "EPS2D", 0.1)
    check(case, eps2d=0.1)
    check(case, torch.float64, eps2d=0.1)


@st.composite
def scenes(draw) -> Case:
    """Clouds from opaque to transparent, from dust to planets, round to needle-like, near and far, 1 or 2 cameras."""
    g = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    n = draw(st.integers(0, 40))
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    log_size, spread = draw(st.floats(-5, 1.5)), draw(st.floats(0, 2))
    cameras = draw(st.integers(1, 2))
    depth = draw(st.floats(0.3, 5)) + 3 * torch.rand(n, generator=g)
    pose = torch.eye(4).repeat(cameras, 1, 1)
    pose[:, :3, 3] += 0.2 * torch.randn(cameras, 3, generator=g)
    fov, centre = draw(st.floats(20, 140)), (draw(st.floats(-0.3, 1.3)), draw(st.floats(-0.3, 1.3)))
    options = {
        "render_mode": draw(st.sampled_from(["RGB", "RGB+ED"])),
        "rasterize_mode": draw(st.sampled_from(["classic", "antialiased"])),
    }
    return Case(
        means=torch.cat([1.5 * torch.randn(n, 2, generator=g), depth[:, None]], 1),
        quats=torch.randn(n, 4, generator=g) * draw(st.floats(0.1, 10)),
        scales=torch.exp(log_size + spread * torch.randn(n, 3, generator=g)),
        opacities=torch.rand(n, generator=g) ** draw(st.floats(0.05, 3)),
        colors=torch.randn(n, draw(st.integers(1, 5)), generator=g),
        viewmats=pose,
        Ks=_camera(width, height, fov, centre).repeat(cameras, 1, 1),
        width=width,
        height=height,
        options=options,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=30, derandomize=True)
@given(case=scenes())
def test_random_scenes(dtype, case):
    check(case, dtype)


@pytest.mark.slow
@settings(max_examples=1000)
@given(scenes(), st.sampled_from([torch.float32, torch.float64]))
def test_many_random_scenes(case, dtype):
    """New scenes every time: the search, where the two above are the regression test."""
    check(case, dtype)


RECORDED = Path(__file__).resolve().parents[1] / "fixtures" / "gsplat.npz"
DENSE_FLOOR = 0.01
"""`MIN_DISCRIMINANT` of gsplat 1.4's dense kernel, which made the records."""


@pytest.mark.parametrize("name", sorted(CASES))
def test_gsplat_and_the_cpu_agree_with_the_twin(name, monkeypatch):
    """Both lie within its tolerance, so they are within twice of each other, and radii within 1."""
    case, grads, gsplat = load(RECORDED, name)
    verdict = judge(case, grads, floor=DENSE_FLOOR)
    assert_agrees(verdict, gsplat)
    monkeypatch.setattr(projection, "MIN_DISCRIMINANT", DENSE_FLOOR)
    assert_agrees(verdict, evaluate(rasterization, case, grads, "cpu"))


@pytest.mark.gpu
@pytest.mark.parametrize("kernels", ["ours", "gsplat's"])
@pytest.mark.parametrize("name", sorted(CASES))
def test_gpu_back_end_agrees_with_the_twin(name, kernels, monkeypatch):
    """With our compositing and with gsplat's, which are so within twice the tolerance of each other."""
    from nrfgs_ns.rasterizer import gsplat_cuda

    case, bounds = CASES[name](), BOUNDS["cuda"]
    if kernels == "gsplat's":
        monkeypatch.setattr(gsplat_cuda, "_compositing_runs_on", lambda _: False)
    grads = upstream(case, bounds=bounds)
    assert_agrees(judge(case, grads, bounds=bounds), evaluate(rasterization, case, grads, "cuda"))


# Our compositing alone; in Triton's interpreter: kernels/small_interpreted.py.
@pytest.mark.gpu
class TestOurKernels:
    def test_a_crowd(self, monkeypatch):
        """Around 130 splats in each tile: several batches, which hand light on."""
        draw_with_our_kernels(monkeypatch, "cuda")
        case = _cloud(31, n=300, width=100, height=70, scales=lambda s: 4 * s, opacities=lambda o: 0.2 * o)
        check(for_our_kernels(case))

    @settings(max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(case=scenes().map(for_our_kernels))
    def test_random_scenes(self, monkeypatch, case):
        draw_with_our_kernels(monkeypatch, "cuda")
        check(case)
