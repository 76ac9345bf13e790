# SPDX-License-Identifier: Apache-2.0
"""Values passed between the rasterizer's stages, and gsplat's constants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

RasterizeMode = Literal["classic", "antialiased"]

EPS2D = 0.3
"""Blur added to the 2D covariances, in square pixels."""
TILE_SIZE = 16
"""Side, in pixels, of the tiles at whose borders a splat ends beyond its radius."""


@dataclass(frozen=True)
class ProjectionOptions:
    """Options of a projection."""

    rasterize_mode: RasterizeMode = "classic"
    """classic: the blur makes splats wider. antialiased: it also makes them fainter, so that their light is kept"""
    near_plane: float = 0.01
    """smallest visible depth, in world units"""
    far_plane: float = 1e10
    """largest visible depth, in world units"""
    assume_finite: bool = False
    """do not check that splats are finite, which costs a GPU a wait; a training's guard finds those that are not"""
    every_row: bool = False
    """keep invisible splats as rows of radius 0, so that the number of rows is constant; one camera, on CUDA"""


@dataclass
class Projection:
    """Visible splats in gsplat's packed layout: one row per (camera, visible splat) pair, M rows, by camera, then by
    splat."""

    camera_ids: Tensor
    """Camera of each row. [M], int64"""
    gaussian_ids: Tensor
    """Splat of each row. [M], int64"""
    radii: Tensor
    """Half the side, in pixels, of the square of three standard deviations around the splat; 0 in invisible rows
    (`ProjectionOptions.every_row`). [M], int32"""
    means2d: Tensor
    """Projected centre in pixels; the top left pixel's centre is (0.5, 0.5). [M, 2]"""
    depths: Tensor
    """Camera-space z. [M]"""
    conics: Tensor
    """Upper triangle (xx, xy, yy) of the inverse of the blurred 2D covariance, in 1 / pixel^2. [M, 3]"""
    compensations: Tensor | None
    """Opacity factor sqrt(det / det_blurred), in [0, 1]; None in classic mode. [M]"""
    width: int
    height: int
    """Image size in pixels."""
    n_cameras: int
    extents: Tensor | None = None
    """Half the sides, in pixels, of the rectangle around each splat; gsplat 1.5's alone. [M, 2], int32"""
