# SPDX-License-Identifier: Apache-2.0
"""The kernels of the tiles' lists in Triton's interpreter against every pixel of every tile."""

import quick_interpreter  # noqa: F401
import torch
from tile_list_cases import Splats, assert_lists, splats

from nrfgs_ns.rasterizer.tile_lists import tile_lists


def test_tiles_list_what_draws_in_them():
    of = splats(200, 100, 70)
    lists = tile_lists(*of, 7, 5, 16)
    assert assert_lists(*lists, of, 7, 5, 16) <= 0.1 * len(lists[1])


def test_rectangles_bound_splats():
    of = splats(60, 60, 40, seed=1)
    of = of._replace(radii=torch.stack([of.radii, (of.radii + 1) // 2], dim=1))
    assert_lists(*tile_lists(*of, 8, 5, 8), of, 8, 5, 8)


def test_splats_that_are_long_far_off_or_no_ellipses():
    """A line of a pixel's width across the image, one whose centre is far outside, and a conic without determinant."""
    of = Splats(
        means2d=torch.tensor([[50.0, 30.0], [-3000.0, -3000.0], [20.0, 20.0]]),
        radii=torch.tensor([3000, 5000, 20], dtype=torch.int32),
        depths=torch.tensor([3.0, 2.0, 1.0]),
        conics=torch.tensor([[0.51, -0.4999999, 0.49], [1e-6, 0.0, 1e-6], [0.5, 0.5, 0.5]]),
        opacities=torch.tensor([0.9, 0.9, 0.9]),
    )
    assert_lists(*tile_lists(*of, 7, 5, 16), of, 7, 5, 16)


def test_what_is_not_finite_is_left_out():
    of = splats(40, 60, 40, seed=2)
    colors = torch.rand(len(of.depths), 4)
    bad = Splats(*(table.clone() for table in of))
    bad.means2d[0, 1] = bad.conics[1, 2] = bad.opacities[2] = float("nan")
    bad.conics[3, 0] = float("inf")
    colors[4, 3], colors[5, 0] = float("inf"), float("nan")
    _, rows = tile_lists(*bad, 4, 3, 16, colors)
    whole = tile_lists(*of, 4, 3, 16)[1]
    assert rows.tolist() == [row for row in whole.tolist() if row > 5]
    shown = tile_lists(*bad, 4, 3, 16)[1].tolist()  # without a check they are listed, and show
    assert shown.count(1) >= whole.tolist().count(1) > 0 and shown.count(2) >= whole.tolist().count(2)
    assert {3, 4} & set(whole.tolist())
