# SPDX-License-Identifier: Apache-2.0
"""The call: arguments, layouts, errors, and what gsplat's strategies need of `info`. The tiles' lists against their
definition: every splat that reaches a pixel is listed there, in order, and little else."""

import math
import subprocess
import sys

import pytest
import torch
from gsplat_call import assert_background_shines, rasterization
from make_gsplat_fixtures import CASES, _camera
from tile_list_cases import Splats, assert_lists, splats

from nrfgs_ns.rasterizer import TILE_SIZE, ProjectionOptions, composite, project
from nrfgs_ns.rasterizer.torch_cpu import compositing
from nrfgs_ns.rasterizer.torch_cpu.tiles import SUB_TILE, find_footprints, list_tiles


def test_info_has_gsplats_keys():
    _, _, info = rasterization(*CASES["ordinary"]().arguments())
    assert set(info) == {
        *("camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities"),
        *("tile_width", "tile_height", "width", "height", "tile_size", "n_cameras"),
    }
    assert (info["tile_width"], info["tile_height"], info["n_cameras"]) == (4, 3, 1)  # 60 x 44 in tiles of 16


def test_background_shines_through_and_has_a_gradient():
    assert_background_shines(CASES["ordinary"]())


def test_other_devices_are_refused():
    case = CASES["one_splat"]()
    with pytest.raises(NotImplementedError, match="device meta"):
        rasterization(*(t.to("meta") for t in case.arguments()[:7]), case.width, case.height)


def test_cpu_path_imports_no_gsplat():
    """Importing gsplat's kernels compiles them where nvcc exists; the CPU path must work without gsplat altogether."""
    program = (
        "import sys; sys.modules['gsplat'] = None\n"
        "import torch; from nrfgs_ns.rasterizer import composite, project\n"
        "x = [torch.ones(2, n) for n in (3, 4, 3)]\n"
        "seen = project(*x, torch.eye(4)[None], torch.eye(3)[None], 8, 8)\n"
        "image = composite(seen, torch.ones(2, 3), torch.ones(2))[0]\n"
        "assert image.shape == (1, 8, 8, 3) and image.sum() > 0"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def test_no_setting_lowers_the_precision():
    """`set_float32_matmul_precision("medium")`, popular in training scripts, makes CPU products bfloat16."""
    case = CASES["ordinary"]()
    expected = rasterization(*case.arguments())[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(rasterization(*case.arguments())[0], expected)
    usual = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("medium")
        assert torch.equal(rasterization(*case.arguments())[0], expected)
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(usual)


def in_a_row(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Means of splats behind each other from depth 1 to 2, and a lens in the middle of 8 x 8 pixels."""
    means = torch.cat([torch.zeros(count, 2), torch.linspace(1, 2, count)[:, None]], 1)
    return means, torch.tensor([[[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]]])


def test_one_very_long_tile():
    """Twenty thousand splats over one 8 x 8 tile, faint enough that light is left: the sum has a closed form.

    All splats are flat over the tile (sigma ~ 0), so alpha = o for each and T = (1 - o)^n up to n roundings: 20,000 x
    2^-24 = 1e-3.
    """
    n, o = 20_000, 0.004
    means, K = in_a_row(n)
    opacities = torch.full((n,), o, requires_grad=True)
    scales, quats = torch.full((n, 3), 1e4), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
    _, alphas, _ = rasterization(means, quats, scales, opacities, torch.ones(n, 1), torch.eye(4)[None], K, 8, 8)
    drawn = math.floor(math.log(1e-4) / math.log1p(-o))  # T falls to 1e-4 after these
    torch.testing.assert_close(1 - alphas, torch.full_like(alphas, (1 - o) ** drawn), rtol=5e-3, atol=0)
    alphas.sum().backward()
    assert (opacities.grad[:drawn] > 0).all() and (opacities.grad[drawn + 1 :] == 0).all()


def test_hidden_splats_cost_nothing(monkeypatch):
    """Behind an opaque wall of 20 layers, 5000 more splats are never looked at: one slab of 16 instead of 314."""
    looked_at, batch = [], compositing.Batch
    monkeypatch.setattr(compositing, "Batch", lambda *a: looked_at.append(tuple(a[1].shape)) or batch(*a))
    n = 5020
    means, K = in_a_row(n)
    shape = [torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1), torch.full((n, 3), 10.0)]
    rasterization(means, *shape, torch.full((n,), 0.9), torch.ones(n, 1), torch.eye(4)[None], K, 8, 8)
    assert looked_at == [(1, compositing.SLAB)]  # tiles, splats


PEAK = """
import sys
from pathlib import Path

import torch

from nrfgs_ns.rasterizer import composite, project


def memory(line):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(text.split()[1]) / 1024 for text in lines if text.startswith(line))


def forward_and_backward(n, width, height):
    g, focal = torch.Generator().manual_seed(0), 0.8 * width
    depth = 2 + 6 * torch.rand(n, 1, generator=g)
    pixel = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([width, height])
    scales = 2.0 / focal * depth * torch.exp(0.5 * torch.randn(n, 3, generator=g))  # around two pixels
    splats = [torch.cat([pixel / focal * depth, depth], 1), torch.randn(n, 4, generator=g), scales]
    splats += [torch.rand(n, 3, generator=g), torch.rand(n, generator=g)]
    means, quats, scales, colors, opacities = (table.requires_grad_() for table in splats)
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]])
    before = memory("VmRSS")
    p = project(means, quats, scales, torch.eye(4)[None], K, width, height)
    image, alphas, _ = composite(p, colors[p.gaussian_ids], opacities[p.gaussian_ids])
    (image.sum() + alphas.sum()).backward()
    return memory("VmHWM") - before


torch.set_num_threads(2)
forward_and_backward(100, 32, 32)  # loads libraries and starts threads
print(forward_and_backward(*map(int, sys.argv[1:])))
"""
"""MiB by which a cloud's forward and backward raise the process's peak."""


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1600, 1200), (800, 600)])
def test_peak_memory_is_bounded(size):
    """Forward and backward of 200,000 splats stay within 1 GiB above their inputs, in a process of their own."""
    command = [sys.executable, "-c", PEAK, "200000", *map(str, size)]
    assert float(subprocess.run(command, check=True, capture_output=True, text=True).stdout) < 1024


@pytest.mark.parametrize("name", [n for n in CASES if n not in ("nothing_visible", "near_plane")])
def test_lists_are_complete_ordered_and_tight(name):
    """The ellipse can pass between pixel centres of a tile that it enters, so some pairs turn out empty. Never most of
    them for splats wider than a pixel; a bounding box would list three times too many for the needles."""
    case, spare = CASES[name](), 0
    with torch.no_grad():
        seen = project(case.means, case.quats, case.scales, case.viewmats, case.Ks, case.width, case.height)
    of = Splats(seen.means2d, seen.radii, seen.depths, seen.conics, case.opacities[seen.gaussian_ids])
    prints = find_footprints(seen, of.opacities)
    lists = list_tiles(prints, prints.whole)
    counts = torch.zeros(seen.n_cameras * prints.tiles_y * prints.tiles_x, dtype=torch.int64)
    counts[lists.tiles] = lists.count
    counts = counts.view(seen.n_cameras, -1)
    rows = prints.rows[lists.splat[:-1]].int().split(counts.sum(dim=1).tolist())
    for camera, mine in enumerate(rows):
        own = seen.camera_ids == camera
        begins = torch.cat([counts[camera].cumsum(0) - counts[camera], torch.full((prints.tiles_x,), len(mine))])
        lists_of_camera = begins.view(1, -1, prints.tiles_x).int(), mine - own.int().argmax()
        of_camera = Splats(*(table[own] for table in of))
        spare += assert_lists(*lists_of_camera, of_camera, prints.tiles_x, prints.tiles_y, SUB_TILE)
    assert lists.n_pairs <= 1.5 * (lists.n_pairs - spare) + 20


def test_blocks_without_a_pair(monkeypatch):
    """A diagonal needle misses most blocks of its bounding box: single sub-tiles, listed with nothing in them."""
    K = torch.tensor([[[60.0, 0.0, 50.0], [0.0, 60.0, 50.0], [0.0, 0.0, 1.0]]])
    needle = [torch.tensor([row]) for row in ([0.0, 0.0, 2.0], [0.924, 0.0, 0.0, 0.383], [2.0, 1e-3, 1e-3])]
    arguments = (*needle, torch.tensor([0.9]), torch.ones(1, 3, requires_grad=True), torch.eye(4)[None], K, 100, 100)
    whole, _, _ = rasterization(*arguments)
    monkeypatch.setattr(compositing, "BLOCK_PAIRS", 1)
    parts, _, _ = rasterization(*arguments)
    torch.testing.assert_close(parts, whole)
    parts.sum().backward()
    torch.testing.assert_close(arguments[4].grad.sum(), whole.sum().detach())


# Projection: extreme gradients, and the order of rows.
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
    Each entry is a sum of some ten products: it may be off by 64 rounding units of the largest."""
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


# On a GPU: gsplat's images and gradients from the lists. In Triton's interpreter: kernels/small_interpreted.py.
@pytest.mark.gpu
class TestOnCuda:
    @pytest.mark.parametrize("shape", [(19, 13, 16), (38, 25, 8)])
    def test_tiles_list_what_draws_in_them(self, shape):
        from nrfgs_ns.rasterizer.tile_lists import tile_lists

        of = splats(3000, 300, 200)
        width, height, side = shape
        lists = tile_lists(*(table.cuda() for table in of), width, height, split=side < TILE_SIZE)
        begins, rows = (part.cpu() for part in lists)
        assert_lists(begins, rows[: begins[0, -1, 0]], of, *shape)

    def test_more_small_tiles_than_numbers(self):
        """A splat in the last of 400 rows of 512 tiles."""
        from nrfgs_ns.rasterizer.tile_lists import tile_lists

        one = torch.ones(1).cuda()
        last = torch.tensor([[4092.0, 3196.0]]).cuda(), one.int(), one, torch.tensor([[1.0, 0.0, 1.0]]).cuda(), one
        begins, rows = tile_lists(*last, 512, 400, split=True)
        assert begins.flatten().tolist() == [0] * 512 * 400 + [1] * 512 and rows[0] == 0

    @pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
    @pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
    def test_images_and_gradients_are_those_of_gsplats_lists(self, monkeypatch, mode, rasterize_mode):
        """Both by gsplat's kernels."""
        from nrfgs_ns.rasterizer import gsplat_cuda

        monkeypatch.setattr(gsplat_cuda, "_compositing_runs_on", lambda _: False)
        count, generator = 5000, torch.Generator().manual_seed(0)

        def random(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=generator).cuda()

        tables = [2 * random(count, 3), random(count, 4), (0.7 * random(count, 3) - 3).exp()]
        tables[0][:, 2] += 6.0
        tables += [torch.sigmoid(random(count, 3)), torch.sigmoid(2 * random(count) - 1)]
        upstream = random(1, 200, 300, 3 if mode == "RGB" else 4)
        camera = torch.eye(4).cuda()[None], torch.tensor([[[200.0, 0, 150], [0, 200, 100], [0, 0, 1]]]).cuda(), 300, 200

        def render() -> tuple[list[torch.Tensor], int]:
            """Image and gradients, and the number of pairs of splats and tiles."""
            leaves = [table.clone().requires_grad_() for table in tables]
            *geometry, colors, opacities = leaves
            seen = project(*geometry, *camera, ProjectionOptions(rasterize_mode, assume_finite=True))
            rows = seen.gaussian_ids
            options = {"with_depth": mode == "RGB+ED", "assume_finite": True}
            background = torch.full((1, 3), 0.3).cuda()
            image, _, info = composite(seen, colors[rows], opacities[rows], backgrounds=background, **options)
            image.backward(upstream)
            offsets, pairs = info["isect_offsets"], len(info["flatten_ids"])
            if offsets.shape[1] > info["tile_height"]:  # the row below the image has spare room
                pairs = int(offsets[0, -1, 0])
            return [image.detach(), *(leaf.grad for leaf in leaves)], pairs

        assert gsplat_cuda._kernels_run_on(torch.device("cuda", 0))
        mine, pairs = render()
        monkeypatch.setattr(gsplat_cuda, "MOST_TILES", 0)
        theirs, all_pairs = render()
        assert pairs <= all_pairs
        torch.testing.assert_close(mine[0], theirs[0], rtol=0, atol=2e-6)
        for got, expected in zip(mine[1:], theirs[1:], strict=True):
            assert (got - expected).norm() <= 1e-5 * expected.norm()  # atomics add in any order
