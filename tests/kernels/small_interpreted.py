# SPDX-License-Identifier: Apache-2.0
"""Kernels of the loss, growth, the tiles' lists and compositing in Triton's interpreter against their twins."""

from dataclasses import replace

import pytest
import quick_interpreter  # noqa: F401
import torch
from agreement import assert_agrees, judge
from gsplat_call import Theirs, assert_background_shines, draw_with_our_kernels, for_our_kernels, rasterization
from hypothesis import HealthCheck, given, settings
from make_gsplat_fixtures import CASES, evaluate, upstream
from ssim_cases import TOLERANCE, assert_near, pair
from test_against_twin import scenes
from tile_list_cases import Splats, assert_lists, splats
from torch.testing import assert_close

from nrfgs_ns.densification.statistics import Statistics, in_torch
from nrfgs_ns.densification.statistics_triton import in_triton
from nrfgs_ns.image import ssim_triton
from nrfgs_ns.image.ssim import photometric_loss
from nrfgs_ns.rasterizer import TILE_SIZE, gsplat_cuda
from nrfgs_ns.rasterizer.tile_lists import Room, tile_lists


# The loss, against pytorch_msssim in float64. A row of a program takes about a tenth of a second, hence small images.
def test_several_blocks_and_strips(monkeypatch):
    """Windows cross the borders of two blocks of columns and of two strips of rows."""
    monkeypatch.setattr(ssim_triton, "COLUMNS", 32)
    monkeypatch.setattr(ssim_triton, "ROWS", 6)
    prediction, truth = pair(12, 18)
    assert_near(ssim_triton.WeightedSum.apply(prediction, truth, 0.8, -0.2, 0.2), prediction, truth, 0.2, TOLERANCE)


def test_one_window_and_upstream_gradient(monkeypatch):
    monkeypatch.setattr(ssim_triton, "COLUMNS", 64)
    monkeypatch.setattr(ssim_triton, "ROWS", 11)
    prediction, truth = pair(11, 11)
    got = ssim_triton.WeightedSum.apply(prediction, truth, 0.0, -1.0, 1.0)
    (3.0 * got).backward()
    twin = prediction.detach().double().requires_grad_()
    expected = photometric_loss(twin, truth.double(), 1.0)
    (3.0 * expected).backward()
    assert (got.double() - expected).abs() <= TOLERANCE
    assert (prediction.grad - twin.grad).abs().max() <= TOLERANCE * twin.grad.abs().max()


# The growth's statistics.
@pytest.mark.parametrize("wanted", [(True, True, True), (False, True, True), (True, False, True), (True, True, False)])
@pytest.mark.parametrize("visible", [0, 1, 300])
def test_the_kernel_remembers_what_its_twin_remembers(wanted, visible):
    torch.manual_seed(0)
    rows, radii = torch.randperm(400)[:visible], torch.randint(0, 5, (visible,), dtype=torch.int32)
    gradients = torch.randn(visible, 2)
    gradients[::7, 0], gradients[1::7, 1] = torch.nan, torch.inf
    tables = torch.rand(400) / 50, torch.rand(400) * 300, torch.rand(400) - 1.0
    mine = Statistics(*(table if want else None for table, want in zip(tables, wanted, strict=True)))
    theirs = Statistics(*(None if value is None else value.clone() for value in mine))
    shown = {"gaussian_ids": rows, "radii": radii, "width": 400, "height": 300}, (400.0, 300.0), gradients
    in_triton(mine, *shown)
    in_torch(theirs, *shown)
    for value, twin in zip(mine, theirs, strict=True):
        if twin is not None:
            assert torch.isfinite(twin).all()
            assert_close(value, twin, rtol=1e-6, atol=0.0)


# The tiles' lists, against every pixel of every tile.
def test_tiles_list_what_draws_in_them():
    of = splats(200, 100, 70)
    begins, rows = tile_lists(*of, 7, 5)
    assert assert_lists(begins, rows, of, 7, 5, TILE_SIZE) <= 0.1 * len(rows)


def test_split_lists_are_those_of_tiles_of_their_size(monkeypatch):
    """Split in batches that end inside of a tile's list, and with room to spare."""
    monkeypatch.setattr("nrfgs_ns.rasterizer.tile_lists.BATCH", 16)
    of = splats(200, 100, 70)
    with Room(2000, torch.device("cpu")).in_use():
        begins, rows = tile_lists(*of, 13, 9, split=True)
    listed = rows[: begins[0, -1, 0]]
    assert assert_lists(begins, listed, of, 13, 9, TILE_SIZE // 2) <= 0.1 * len(listed)


def test_the_most_tiles():
    """A splat in the last tile of row 249, of 256 with the row below the image."""
    one = torch.ones(1)
    last = torch.tensor([[4088.0, 3992.0]]), one.int(), one, torch.tensor([[1.0, 0.0, 1.0]]), one
    begins, rows = tile_lists(*last, 256, 255)
    assert begins.flatten().tolist() == [0] * 250 * 256 + [1] * 6 * 256 and rows.tolist() == [0]


def test_rectangles_bound_splats():
    of = splats(60, 60, 40, seed=1)
    of = of._replace(radii=torch.stack([of.radii, (of.radii + 1) // 2], dim=1))
    assert_lists(*tile_lists(*of, 4, 3), of, 4, 3, TILE_SIZE)


def test_splats_that_are_long_far_off_or_no_ellipses():
    """A line of a pixel's width across the image, one whose centre is far outside, and a conic without determinant."""
    of = Splats(
        means2d=torch.tensor([[50.0, 30.0], [-3000.0, -3000.0], [20.0, 20.0]]),
        radii=torch.tensor([3000, 5000, 20], dtype=torch.int32),
        depths=torch.tensor([3.0, 2.0, 1.0]),
        conics=torch.tensor([[0.51, -0.4999999, 0.49], [1e-6, 0.0, 1e-6], [0.5, 0.5, 0.5]]),
        opacities=torch.tensor([0.9, 0.9, 0.9]),
    )
    assert_lists(*tile_lists(*of, 7, 5), of, 7, 5, TILE_SIZE)


def test_what_is_not_finite_is_listed_and_shows():
    of = splats(40, 60, 40, seed=2)
    bad = Splats(*(table.clone() for table in of))
    bad.conics[1, 2] = bad.opacities[2] = float("nan")
    whole, shown = (tile_lists(*these, 4, 3)[1].tolist() for these in (of, bad))
    assert shown.count(1) >= whole.count(1) > 0 and shown.count(2) >= whole.count(2)


# Compositing, from the lists to `absgrad`, against the float64 twin. The room has spare pairs, which are not drawn.
@pytest.fixture
def ours(monkeypatch):
    draw_with_our_kernels(monkeypatch, "cpu")
    with Room(2000, torch.device("cpu")).in_use():
        yield


def window(case):
    """3 x 2 tiles from the middle of an image: the interpreter takes half a second for each."""
    width, height = min(case.width, 24), min(case.height, 12)
    Ks = case.Ks.clone()
    Ks[:, :2, 2] -= 8.0 * torch.tensor([(case.width - width) // 16, (case.height - height) // 16])
    return replace(case, Ks=Ks, width=width, height=height)


def check(case):
    case = window(for_our_kernels(case))
    grads = upstream(case)
    assert_agrees(judge(case, grads), evaluate(rasterization, case, grads, "cpu"))


@pytest.mark.parametrize(
    "name", ["opaque_layers", "larger_than_image", "needles", "opacities_0_to_1", "capped", "antialiased"]
)
def test_hard_cases(ours, name):
    """Together more splats in a tile than a batch, light that runs out, alphas at both cut-offs and at the cap."""
    check(CASES[name]())


@settings(max_examples=12, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(case=scenes())
def test_random_scenes(ours, case):
    check(case)


def test_a_background_shines_through_and_has_a_gradient(ours):
    info = assert_background_shines(window(CASES["one_splat"]()))
    assert info["tile_size"] == 8 and info["isect_offsets"].shape == (1, 3, 3)


def test_what_gsplats_kernels_composite(ours, monkeypatch):
    case = window(CASES["one_splat"]())
    rasterization(*case.arguments())
    with torch.no_grad(), pytest.raises(Theirs):
        rasterization(*case.arguments())
    with pytest.raises(Theirs):
        rasterization(*case.arguments(), render_mode="RGB+ED")
    monkeypatch.setattr(gsplat_cuda, "_compositing_runs_on", lambda _: False)
    with pytest.raises(Theirs):
        rasterization(*case.arguments())
