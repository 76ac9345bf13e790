# SPDX-License-Identifier: Apache-2.0
"""Extremes of geometry and compositing: a splat at the end of its range, or beyond, among five ordinary ones, on the
CPU and under the marker `gpu` on CUDA."""

import math

import pytest
import torch
from agreement import devices
from gsplat_call import rasterization
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.rasterizer import Projection, ProjectionOptions, gsplat_cuda, project
from nrfgs_ns.rasterizer.torch_cpu.projection import MIN_QUATERNION

WIDTH, HEIGHT, FOCAL = 40, 28, 40.0
NAMES = ("means", "quats", "scales", "opacities", "colors")
modes = pytest.mark.parametrize("mode", ["classic", "antialiased"])
everywhere = lambda test: devices(modes(test))  # noqa: E731


def cloud(device: str = "cpu", count: int = 6, **planted) -> dict[str, torch.Tensor]:
    """Splats in front of the camera at the origin; `planted` are values for splat 0."""
    g = torch.Generator().manual_seed(0)
    splats = {
        "means": torch.cat([0.3 * torch.randn(count, 2, generator=g), 2 + torch.rand(count, 1, generator=g)], 1),
        "quats": torch.randn(count, 4, generator=g),
        # Oblong: the gradient of a round splat's quaternion is nothing but rounding.
        "scales": torch.tensor([0.1, 0.15, 0.07]).repeat(count, 1),
        "opacities": torch.full((count,), 0.5),
        "colors": torch.rand(count, 3, generator=g),
    }
    for name, value in planted.items():
        splats[name][0] = torch.as_tensor(value)
    return {name: value.to(device).requires_grad_() for name, value in splats.items()}


def camera(device: str = "cpu", width: int = WIDTH, height: int = HEIGHT) -> tuple:
    K = torch.tensor([[FOCAL, 0.0, width / 2], [0.0, FOCAL, height / 2], [0.0, 0.0, 1.0]], device=device)
    return torch.eye(4, device=device)[None], K[None], width, height


def render(splats, view=None, **options):
    view = view or camera(splats["means"].device.type)
    return rasterization(*(splats[name] for name in NAMES), *view, render_mode="RGB+ED", **options)


def assert_healthy(splats, view=None, **options):
    """Finite images in their ranges, finite gradients and absgrad; returns image, opacity and info."""
    image, alpha, info = render(splats, view, absgrad=True, **options)
    assert torch.isfinite(image).all()
    assert ((alpha >= 0) & (alpha <= 1)).all()
    (image.sum() + alpha.sum()).backward()
    for name, value in splats.items():
        assert torch.isfinite(value.grad).all(), name
    assert torch.isfinite(info["means2d"].absgrad).all()
    for name in ("means2d", "depths", "conics", "opacities"):
        assert torch.isfinite(info[name]).all(), name
    return image.detach(), alpha.detach(), info


@everywhere
@pytest.mark.parametrize("depth", [-1.0, 0.0, 0.0099, 0.01, 0.0101, 1e3, 1e6, 9.9e9, 1e10, 1e20])
def test_depths_from_the_lens_to_beyond_the_far_plane(device, mode, depth):
    _, _, info = assert_healthy(cloud(device, means=[0.0, 0.0, depth]), rasterize_mode=mode)
    assert (0 in info["gaussian_ids"]) == (0.01 <= depth <= 1e10)


@everywhere
@settings(max_examples=25, derandomize=True)
@given(exponent=st.floats(-40, 20), shape=st.sampled_from(["ball", "disc", "needle"]), depth=st.floats(-1.9, 4))
def test_log_scales_from_minus_40_to_plus_20(device, mode, exponent, shape, depth):
    size = math.exp(exponent)
    scales = {"ball": [size] * 3, "disc": [size, size, 1e-6], "needle": [size, 1e-6, 1e-6]}[shape]
    assert_healthy(cloud(device, means=[0.05, -0.02, 10.0**depth], scales=scales), rasterize_mode=mode)


@modes
@pytest.mark.parametrize("exponent", [15.0, 20.0, 38.0])
def test_a_splat_of_planetary_size_is_an_even_veil(mode, exponent):
    """sigma = d^2 / (2 (f s / z)^2) <= 50^2 / (2 * 6e7^2) = 3e-13: every pixel has the splat's own opacity. In the
    antialiased mode the blur of 0.3 px takes nothing from it either."""
    splats = cloud(count=1, means=[0.0, 0.0, 2.0], scales=[math.exp(exponent)] * 3, opacities=0.5)
    _, alpha, _ = assert_healthy(splats, rasterize_mode=mode)
    assert torch.allclose(alpha, torch.full_like(alpha, 0.5), rtol=0, atol=1e-6)


def test_a_splat_whose_square_overflows_harms_nothing():
    assert_healthy(cloud(scales=[1e38] * 3))


def test_a_splat_without_extent_is_a_point_of_blur():
    """Its covariance is 0.3 I: alpha = o exp(-d^2 / 0.6) within its square of 3 pixels, and its tiles."""
    for size in (0.0, 1e-45, math.exp(-40)):
        _, alpha, info = assert_healthy(cloud(count=1, means=[0.0, 0.0, 2.0], scales=[size] * 3))
        x, y = torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy")
        expected = 0.5 * torch.exp(-((x - WIDTH / 2).square() + (y - HEIGHT / 2).square()) / 0.6)
        expected = torch.where(expected >= 1 / 255, expected, 0.0)
        # exp of at most 5, 8 roundings deep, of numbers below 0.5.
        assert torch.allclose(alpha[0, ..., 0], expected, rtol=0, atol=5e-7)
        assert info["radii"].tolist() == [3]


@everywhere
@pytest.mark.parametrize("far", [1e6, -1e6, 1e18, -3e38])
@pytest.mark.parametrize("size", [0.1, 1e6, 1e18])
def test_far_to_the_side(device, mode, far, size):
    assert_healthy(cloud(device, means=[far, 0.0, 2.0], scales=[size] * 3), rasterize_mode=mode)


@pytest.mark.parametrize("coordinate", [1e-6, 1e6])
def test_coordinates_of_1e_6_and_1e6(coordinate):
    """The whole scene, camera included: sizes and depths in the same unit, so the image is the one of unit 1. The near
    plane would cut the small one off: it is a length too, and is given in the same unit."""
    reference, splats = render(cloud())[0].detach()[..., :3], cloud()
    for name in ("means", "scales"):
        splats[name] = (splats[name].detach() * coordinate).requires_grad_()
    image, _, _ = assert_healthy(splats, near_plane=0.01 * coordinate)
    # Positions of 1e-6 and 1e6 round anew (2^-24 of them, 1e-6 pixels); slopes of an image are below 1 per pixel.
    assert (image[..., :3] - reference).abs().max() < 1e-5


@everywhere
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-19, MIN_QUATERNION * 1.01, 1e-10, 1e10, 1e18, 1e25])
def test_quaternions_of_any_length(device, mode, length):
    """Those whose direction cannot be had are invisible; the others are the unit quaternion."""
    q = torch.tensor([0.5, -0.5, 0.1, 0.7]) / torch.tensor([0.5, -0.5, 0.1, 0.7]).norm()
    unit, *_ = render(cloud(device, quats=q), rasterize_mode=mode)
    splats = cloud(device, quats=q * length)
    if device == "cuda" and length not in (0.0, 1e-10, 1e10, 1e18):
        pytest.skip("gsplat's kernel has another limit")
    image, _, info = assert_healthy(splats, rasterize_mode=mode)
    seen = MIN_QUATERNION <= length <= 1e19
    assert (0 in info["gaussian_ids"]) == seen
    if seen:
        # Normalising is a few roundings off: 1e-6 of the conic, times a falloff's exponent of at most 5.5 (beyond,
        # alpha is below 1/255) 6e-6 of alpha, twice that of a depth of 3, which is a ratio: 4e-5. A pixel whose alpha
        # is at the cut-off of 1/255 to that precision may come or go.
        assert ((image - unit.detach()).abs().amax(-1) > 4e-5).sum() <= 1


@everywhere
@pytest.mark.parametrize("opacity", [-1.0, 0.0, 1e-30, 1 / 255, 0.999, 1.0, 1.5])
def test_opacities_to_both_ends(device, mode, opacity):
    assert_healthy(cloud(device, opacities=opacity), rasterize_mode=mode)


@devices
def test_light_runs_out_behind_many_opaque_splats(device):
    """A hundred layers of opacity 1: alpha is capped at 0.999, a ray ends before T = 1e-4, and so T = 1e-3 is left."""
    splats = {name: value.detach()[:1].repeat(100, *[1] * (value.dim() - 1)) for name, value in cloud().items()}
    splats["means"] = torch.tensor([0.0, 0.0, 1.0]) + torch.arange(100)[:, None] * torch.tensor([0.0, 0.0, 0.01])
    splats["scales"], splats["opacities"] = torch.full((100, 3), 1e6), torch.ones(100)
    _, alpha, _ = assert_healthy({name: value.to(device).requires_grad_() for name, value in splats.items()})
    assert torch.allclose(alpha, torch.full_like(alpha, 0.999), rtol=0, atol=1e-6)


@given(st.floats(0, 1, width=32), st.floats(0, 1, width=32))
@settings(max_examples=25)
def test_opacity_of_the_image_rises_with_a_splats(a, b):
    """One splat behind the others may only darken what is behind all, up to two roundings of T."""
    low, high = (render(cloud(opacities=o))[1].detach() for o in sorted((a, b)))
    assert (high >= low - 2.0**-22).all()


@everywhere
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", NAMES)
def test_a_splat_that_is_not_finite_is_not_there(device, mode, value, name):
    """Image and gradients are those of the scene without it; no NaN reaches a neighbour, or the splat's own rows."""
    without = {key: tensor.detach()[1:].clone().requires_grad_() for key, tensor in cloud(device).items()}
    expected = assert_healthy(without, rasterize_mode=mode)
    splats = cloud(device, **{name: value})
    image, alpha, info = assert_healthy(splats, rasterize_mode=mode)
    assert torch.equal(image, expected[0]) and torch.equal(alpha, expected[1])
    for key in NAMES:
        # Sums over pixels and splats, which a GPU takes in any order: 1e-5 of the largest terms.
        assert (splats[key].grad[1:] - without[key].grad).abs().max() <= 1e-5 * without[key].grad.abs().max(), key
        assert (splats[key].grad[0] == 0).all(), key
    if name in ("means", "quats", "scales"):
        assert 0 not in info["gaussian_ids"]


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """How many splats each call of gsplat's projection has. Its stand-in lets NaN pass, as gsplat's comparisons do, and
    takes no empty table: 1.5.3 divides by the number of splats, and the process would end without a word."""
    counts = []

    def kernel(means, covars, quats, scales, viewmats, Ks, width, height, *, calc_compensations, **settings):
        assert len(means) > 0
        counts.append(len(means))
        harmless = [torch.nan_to_num(table, 0.5, 0.5, 0.5) for table in (means, quats, scales)]
        options = ProjectionOptions("antialiased" if calc_compensations else "classic")
        p = project(*harmless, viewmats, Ks, width, height, options)
        conics = p.conics.masked_fill(~torch.isfinite(means[p.gaussian_ids]).all(1)[:, None], math.nan)
        sides = p.radii[:, None].expand(-1, 2) if gsplat_cuda.HAS_BATCHES else p.radii
        rows = p.camera_ids, p.gaussian_ids, sides, p.means2d, p.depths, conics, p.compensations
        return rows[:1] * gsplat_cuda.HAS_BATCHES + rows

    monkeypatch.setattr(gsplat_cuda, "fully_fused_projection", kernel)
    return counts


def by_gsplat(splats: dict[str, torch.Tensor], **options) -> Projection:
    return gsplat_cuda.project([splats[name] for name in NAMES[:3]], camera(), ProjectionOptions(**options))


def test_rows_that_gsplat_lets_through_as_nan_are_projected_away(calls):
    p = by_gsplat(cloud(means=math.nan))
    assert p.gaussian_ids.tolist() == [1, 2, 3, 4, 5] and calls == [6, 5]
    assert torch.isfinite(p.conics).all()
    by_gsplat(cloud())
    assert calls == [6, 5, 6]  # no second look where nothing is wrong
    by_gsplat(cloud(means=math.nan), assume_finite=True)  # a training's guard finds such splats
    assert calls == [6, 5, 6, 6]


@modes
@pytest.mark.parametrize("bad", [None, math.nan])
def test_gsplats_projection_never_sees_an_empty_table(calls, mode, bad):
    splats = {name: value.detach()[: 0 if bad is None else 2].requires_grad_() for name, value in cloud().items()}
    if bad is not None:
        splats["means"] = torch.full((2, 3), bad, requires_grad=True)
    p = by_gsplat(splats, rasterize_mode=mode)
    assert p.gaussian_ids.shape == (0,) and p.means2d.shape == (0, 2) and p.conics.shape == (0, 3)
    assert p.radii.shape == (0,) and p.radii.dtype == torch.int32
    assert (p.compensations is None) == (mode == "classic") and calls == [2] * (bad is not None)
    (p.means2d.sum() + p.depths.sum() + p.conics.sum()).backward()  # nothing to find, nothing in the way


@everywhere
@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1)])
@pytest.mark.parametrize("count", [0, 1, 6])
def test_images_of_one_pixel_and_scenes_of_no_splat(device, mode, size, count):
    splats = {name: value.detach()[:count].requires_grad_() for name, value in cloud(device).items()}
    image, alpha, _ = render(splats, camera(device, *size), rasterize_mode=mode)
    (image.sum() + alpha.sum()).backward()
    assert image.shape == (1, size[1], size[0], 4) and torch.isfinite(image).all()
    for name, value in splats.items():
        assert value.grad is None or torch.isfinite(value.grad).all(), name


@devices
@pytest.mark.parametrize("color", [1e4, 1e15])
def test_large_colours(device, color):
    """Gradients are as large: below the guard's limit of 2^63 they are let through."""
    image, _, _ = assert_healthy(cloud(device, colors=[color] * 3))
    assert image.max() <= color * 1.001
