# SPDX-License-Identifier: Apache-2.0
"""The call: arguments, layouts, errors, and what gsplat's strategies need of `info`."""

import math
import subprocess
import sys

import pytest
import torch
from gsplat_call import rasterization
from make_gsplat_fixtures import CASES

from nrfgs_ns.rasterizer.torch_cpu import batches, compositing


def test_info_has_gsplats_keys():
    case = CASES["ordinary"]()
    _, _, info = rasterization(*case.arguments())
    assert set(info) == {
        *("camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities"),
        *("tile_width", "tile_height", "width", "height", "tile_size", "n_cameras"),
    }
    assert (info["tile_width"], info["tile_height"], info["n_cameras"]) == (4, 3, 1)  # 60 x 44 in tiles of 16


def test_background_shines_through_and_has_a_gradient():
    case = CASES["ordinary"]()
    background = torch.tensor([[0.3, 0.6, 0.9]], requires_grad=True)
    black, alphas, _ = rasterization(*case.arguments())
    render, _, _ = rasterization(*case.arguments(), backgrounds=background)
    torch.testing.assert_close(render, black + (1 - alphas) * background[:, None, None])
    render.sum().backward()
    torch.testing.assert_close(background.grad, (1 - alphas).sum((1, 2)).expand(1, 3))


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
    looked_at = []
    batch = compositing.Batch
    monkeypatch.setattr(compositing, "Batch", lambda *a: looked_at.append(tuple(a[1].shape)) or batch(*a))
    n = 5020
    means, K = in_a_row(n)
    shape = [torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1), torch.full((n, 3), 10.0)]
    rasterization(means, *shape, torch.full((n,), 0.9), torch.ones(n, 1), torch.eye(4)[None], K, 8, 8)
    assert looked_at == [(1, batches.SLAB)]  # tiles, splats


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
    """Forward and backward of 200,000 splats stay within 1 GiB above their inputs; in a fresh process, for its peak is
    one's own.
    """
    command = [sys.executable, "-c", PEAK, "200000", *map(str, size)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert float(done.stdout) < 1024
