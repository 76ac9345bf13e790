# SPDX-License-Identifier: Apache-2.0
"""The lists against their definition: every splat that reaches a pixel is listed there, in order, and little
else.
"""

import pytest
import torch
from gsplat_call import rasterization
from make_gsplat_fixtures import CASES

from nrfgs_ns.rasterizer import TILE_SIZE as TILE
from nrfgs_ns.rasterizer import project
from nrfgs_ns.rasterizer.torch_cpu import compositing
from nrfgs_ns.rasterizer.torch_cpu.tiles import MIN_ALPHA, SUB_TILE, footprints, list_tiles


def brute_force(projection, opacities):
    """alpha of every (row, pixel) within gsplat's tiles, 0 elsewhere; float64. [M, C, H, W]"""
    y, x = torch.meshgrid(torch.arange(projection.height), torch.arange(projection.width), indexing="ij")
    dx = (x + 0.5) - projection.means2d[:, 0, None, None].double()
    dy = (y + 0.5) - projection.means2d[:, 1, None, None].double()
    a, b, c = (projection.conics[:, i, None, None].double() for i in range(3))
    alpha = opacities[:, None, None].double() * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    within = torch.ones_like(alpha, dtype=torch.bool)
    for pixel, centre in ((x, projection.means2d[:, 0]), (y, projection.means2d[:, 1])):
        first = ((centre - projection.radii) / TILE).floor()[:, None, None]
        end = ((centre + projection.radii) / TILE).ceil()[:, None, None]
        within &= (pixel // TILE >= first) & (pixel // TILE < end)
    camera = torch.arange(projection.n_cameras)[None, :, None, None] == projection.camera_ids[:, None, None, None]
    return torch.where(within, alpha, 0.0)[:, None] * camera


def setup(name):
    case = CASES[name]()
    with torch.no_grad():
        projection = project(case.means, case.quats, case.scales, case.viewmats, case.Ks, case.width, case.height)
    opacities = case.opacities[projection.gaussian_ids]
    return projection, opacities, footprints(projection, opacities)


def tile_maxima(alpha, prints):
    """Largest alpha of each row in each sub-tile. [M, C * tiles]"""
    edge = SUB_TILE
    pad = (0, prints.tiles_x * edge - alpha.shape[-1], 0, prints.tiles_y * edge - alpha.shape[-2])
    return torch.nn.functional.max_pool2d(torch.nn.functional.pad(alpha, pad), edge).flatten(1)


def listed(lists, prints, shape):
    table = torch.zeros(shape, dtype=torch.bool)
    table[prints.rows[lists.splat[:-1]], lists.tiles.repeat_interleave(lists.count)] = True
    return table


@pytest.mark.parametrize("name", [n for n in CASES if n not in ("nothing_visible", "near_plane")])
def test_lists_are_complete_ordered_and_tight(name):
    projection, opacities, prints = setup(name)
    lists = list_tiles(prints, prints.whole)
    maxima = tile_maxima(brute_force(projection, opacities), prints)
    table = listed(lists, prints, maxima.shape)
    assert lists.n_pairs == table.sum(), "a pair is listed twice"
    assert table[maxima >= MIN_ALPHA * (1 + 1e-6)].all(), "a splat that can be seen is missing"
    # The ellipse can pass between pixel centres of a tile that it enters, so some pairs turn out empty. Never most of
    # them for splats wider than a pixel; a bounding box would list three times too many for the needles.
    assert table.sum() <= 1.5 * (maxima >= MIN_ALPHA).sum() + 20

    rows = prints.rows[lists.splat[:-1]]
    depth = projection.depths[rows]
    for start, count in zip(lists.start.tolist(), lists.count.tolist(), strict=True):
        keys = [
            (float(d), int(r)) for d, r in zip(depth[start : start + count], rows[start : start + count], strict=True)
        ]
        assert keys == sorted(keys)


def test_blocks_without_a_pair(monkeypatch):
    """A diagonal needle misses most blocks of its bounding box: single sub-tiles, listed with nothing in them."""
    K = torch.tensor([[[60.0, 0.0, 50.0], [0.0, 60.0, 50.0], [0.0, 0.0, 1.0]]])
    needle = [
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([[0.924, 0.0, 0.0, 0.383]]),
        torch.tensor([[2.0, 1e-3, 1e-3]]),
    ]
    arguments = (*needle, torch.tensor([0.9]), torch.ones(1, 3, requires_grad=True), torch.eye(4)[None], K, 100, 100)
    whole, _, _ = rasterization(*arguments)
    monkeypatch.setattr(compositing, "BLOCK_PAIRS", 1)
    parts, _, _ = rasterization(*arguments)
    torch.testing.assert_close(parts, whole)
    parts.sum().backward()
    torch.testing.assert_close(arguments[4].grad.sum(), whole.sum().detach())
