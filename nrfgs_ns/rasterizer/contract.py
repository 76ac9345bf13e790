# SPDX-License-Identifier: Apache-2.0
"""What the stages of the rasterizer hand to each other."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass
class Projection:
    """What the cameras see: one row per (camera, visible splat) pair, M rows, ordered by camera, then by splat.

    This is the packed layout of gsplat. Everything between projection and compositing (an appearance head, a
    strategy) works on these rows, so nothing is ever evaluated for a splat that no camera sees.
    """

    camera_ids: Tensor
    """Camera of each row. [M], int64"""
    gaussian_ids: Tensor
    """Splat of each row. [M], int64"""
    radii: Tensor
    """Half the side, in pixels, of the square of three standard deviations around the splat. [M], int32; 0 where
    a row was asked for that is not visible, else at least 1"""
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
