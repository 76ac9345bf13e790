# SPDX-License-Identifier: Apache-2.0
"""Values that the stages of the rasterizer hand to each other, and gsplat's constants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

RasterizeMode = Literal["classic", "antialiased"]

EPS2D = 0.3
"""Blur added to the 2D covariances, in square pixels."""
TILE_SIZE = 16
"""Side, in pixels, of the tiles that cut a splat off beyond its radius."""


@dataclass(frozen=True)
class ProjectionOptions:
    """Options of a projection."""

    rasterize_mode: RasterizeMode = "classic"
    """classic: the blur makes splats wider. antialiased: it also makes them fainter, so that their light stays the
    same"""
    near_plane: float = 0.01
    """smallest visible depth, in world units"""
    far_plane: float = 1e10
    """largest visible depth, in world units"""
    assume_finite: bool = False
    """do not look for splats that are not finite, which costs a GPU a wait; a training's guard finds such numbers"""
    every_row: bool = False
    """invisible splats are rows, too, of radius 0, so that the host need not know the number of visible ones; for one
    camera, on CUDA"""


@dataclass
class Projection:
    """Visible splats: one row per (camera, visible splat) pair, M rows, ordered by camera, then by splat.

    This is gsplat's packed layout. Everything between projection and compositing (an appearance head, a strategy) works
    on these rows, so nothing is computed for invisible splats.
    """

    camera_ids: Tensor
    """Camera of each row. [M], int64"""
    gaussian_ids: Tensor
    """Splat of each row. [M], int64"""
    radii: Tensor
    """Half the side, in pixels, of the square of three standard deviations around the splat. [M], int32; at least 1,
    except 0 in invisible rows (`ProjectionOptions.every_row`)"""
    means2d: Tensor
    """Projected centre in pixels; the centre of the top left pixel is (0.5, 0.5). [M, 2]"""
    depths: Tensor
    """Camera-space z. [M]"""
    conics: Tensor
    """Upper triangle (xx, xy, yy) of the inverse of the blurred 2D covariance, in 1 / pixel^2. [M, 3]"""
    compensations: Tensor | None
    """Opacity factor sqrt(det / det_blurred), in [0, 1], in antialiased mode; otherwise None. [M]"""
    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    n_cameras: int
    """Number of cameras C."""
    extents: Tensor | None = None
    """Half the sides, in pixels, of the rectangle around each splat, where the back end has one. [M, 2], int32"""
