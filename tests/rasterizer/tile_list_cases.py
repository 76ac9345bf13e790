# SPDX-License-Identifier: Apache-2.0
"""Projected splats, and which tiles they draw in pixel by pixel, for the tests of the tiles' lists."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.rasterizer import TILE_SIZE


class Splats(NamedTuple):
    """What `tile_lists` takes first."""

    means2d: Tensor
    radii: Tensor
    depths: Tensor
    conics: Tensor
    opacities: Tensor


def splats(count: int, width: int, height: int, seed: int = 0) -> Splats:
    """In and around an image, of a pixel up to the image in size, round or up to a hundred times as long as wide."""
    generator = torch.Generator().manual_seed(seed)

    def normal(scale: float, mean: float) -> Tensor:
        return mean + scale * torch.randn(count, generator=generator)

    size = torch.tensor([width, height])
    means2d = size * (1.4 * torch.rand(count, 2, generator=generator) - 0.2)
    long, short = normal(1.2, 1.0).exp(), normal(1.2, 0.3).exp()
    turn = math.pi * torch.rand(count, generator=generator)
    cos, sin = turn.cos(), turn.sin()
    xx = (cos * long) ** 2 + (sin * short) ** 2 + 0.3
    yy, xy = (sin * long) ** 2 + (cos * short) ** 2 + 0.3, cos * sin * (long**2 - short**2)
    det, middle = xx * yy - xy * xy, 0.5 * (xx + yy)
    radii = (3 * (middle + (middle**2 - det).clamp_min(0.1).sqrt()).sqrt()).ceil()
    seen = ((means2d + radii[:, None] > 0) & (means2d - radii[:, None] < size)).all(dim=1)
    opacities = torch.rand(count, generator=generator) ** 2
    opacities[::7] = 1.0
    opacities[1::7] = 1.0 / 254.0
    opacities[2::7] = 1.0 / 256.0
    depths = torch.rand(count, generator=generator).mul(20).ceil()  # with ties
    conics = torch.stack([yy, -xy, xx], dim=1) / det[:, None]
    return Splats(*(table[seen] for table in (means2d, radii.int(), depths, conics, opacities)))


def drawn_in(of: Splats, column: int, row: int, side: int) -> tuple[Tensor, Tensor]:
    """Whether each splat reaches 1/255 at a pixel of a tile, in float64; and whether its square meets gsplat's tile
    that the tile lies in."""
    pixels = torch.arange(side, dtype=torch.float64) + 0.5
    dx = of.means2d[:, 0, None, None] - (column * side + pixels)[None, None, :]
    dy = of.means2d[:, 1, None, None] - (row * side + pixels)[None, :, None]
    a, b, c = (part.double()[:, None, None] for part in of.conics.unbind(dim=1))
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    reaches = (of.opacities.double()[:, None, None] * torch.exp(-sigma)).amax(dim=(1, 2)) >= 1.0 / 255.0
    radii = of.radii if of.radii.dim() == 2 else of.radii[:, None].expand(-1, 2)
    first, end = (of.means2d - radii) / TILE_SIZE, (of.means2d + radii) / TILE_SIZE
    tile = torch.tensor([column, row]) * side // TILE_SIZE
    return reaches, ((first.floor() <= tile) & (tile < end.ceil())).all(dim=1)


def assert_lists(begins: Tensor, rows: Tensor, of: Splats, width: int, height: int, side: int) -> int:
    """Each tile lists what draws in it, nothing outside of the boxes, near before far, ties in the table's order.
    Returns how many splats are listed in tiles in which no pixel of theirs reaches 1/255."""
    assert begins.shape == (1, height + 1, width) and begins.dtype == rows.dtype == torch.int32
    starts, listed, spare = [*begins.flatten().tolist(), len(rows)], rows.tolist(), 0
    for tile in range(width * height):
        reaches, boxed = drawn_in(of, tile % width, tile // width, side)
        mine = listed[starts[tile] : starts[tile + 1]]
        assert mine == sorted(mine, key=lambda row: (of.depths[row].item(), row))
        assert len(set(mine)) == len(mine)
        assert set((reaches & boxed).nonzero()[:, 0].tolist()) <= set(mine) <= set(boxed.nonzero()[:, 0].tolist())
        spare += len(mine) - int((reaches & boxed).sum())
    return spare
