# SPDX-License-Identifier: Apache-2.0
"""Projection: 3D splats to 2D splats (EWA splatting, Zwicker et al. 2001), with the conventions of gsplat 1.4.

A splat with mean x, rotation R_q and scales s is seen by a camera with rotation W and translation t at

    p = W x + t,        mean2d = (f_x p_x / p_z + c_x,  f_y p_y / p_z + c_y).

The camera flattens its covariance R_q diag(s^2) R_q^T with the Jacobian J of the perspective map, so that

    cov2d = A A^T,      A = J W R_q diag(s)  (2 x 3),      J = [ f_x / p_z    0            -f_x u / p_z ]
                                                               [ 0            f_y / p_z    -f_y v / p_z ]

where (u, v) = (p_x, p_y) / p_z, clamped to within 0.3 tan(fov / 2) beyond the image edges: the linearisation is useless
further out. A blur of e = 0.3 square pixels keeps every splat at least a pixel wide: cov2d + e I.

Two determinants decide everything that follows, and both are differences of large numbers for a needle. Written with
the rows a_0, a_1 of A they are not:

    det(cov2d)       = |a_0 x a_1|^2
    det(cov2d + e I) = det(cov2d) + e trace(cov2d) + e^2.

Backward, each equation above in reverse. Here and in the code d_y stands for dL/dy. The two less usual ones are

    d_a0 = a_1 x d_n,    d_a1 = d_n x a_0                 for the cross product n = a_0 x a_1,
    d_q = (d_q' - q' (q' . d_q')) / |q|                   for the direction q' = q / |q|.

All arrays hold one row per coordinate and one column per splat: each line below is one pass over memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .. import EPS2D, Projection, ProjectionOptions

FOV_MARGIN = 0.3  # how far beyond the image edge J may be evaluated, in units of tan(fov / 2)
RADIUS_SIGMAS = 3.0  # a splat ends at this many standard deviations
MIN_DISCRIMINANT = 0.1  # floor under the square root of the eigenvalue formula, in pixel^4, of gsplat's packed kernel
COMPENSATION_EPS = 1e-6  # bounds the slope of sqrt at 0 in the backward pass
MAX_RADIUS = float(2**30)  # in pixels: representable in int32 and far beyond every image
LARGEST_RADIUS = float(2**63)  # in pixels: products of two lengths on the image plane stay below float32's 2^128
MIN_QUATERNION = 1e-15  # the derivative of normalising goes through 1 / |q|^2, which must stay far below 2^128


class _Screen(NamedTuple):
    """Splats on the image plane of one camera; n splats."""

    means2d: Tensor  # [2, n]
    depths: Tensor  # [n]
    blurred: tuple[Tensor, Tensor, Tensor]  # xx, xy, yy of cov2d + e I, [n] each
    det: Tensor  # det(cov2d), [n]
    det_blurred: Tensor  # det(cov2d + e I), [n]
    slopes: tuple[Tensor, Tensor]  # p_x / p_z, p_y / p_z, [n] each
    clamped: tuple[Tensor, Tensor]  # u, v, [n] each
    directions: Tensor  # quaternions of length 1, [4, n]
    rotations: Tensor  # R_q, [3, 3, n]
    axes: list[Tensor]  # rows of W R_q diag(s), [3, n] each
    rows: tuple[Tensor, Tensor]  # a_0, a_1, [3, n] each
    normal: Tensor  # a_0 x a_1, [3, n]


def directions(quats: Tensor) -> Tensor:
    """Quaternions (w, x, y, z) of length 1; NaN if shorter than MIN_QUATERNION, or too long. [N, 4] -> [4, N]"""
    squared = quats.square().sum(-1, keepdim=True)
    squared = squared.masked_fill((squared < MIN_QUATERNION**2) | squared.isinf(), math.nan)
    return (quats / squared.sqrt()).t().contiguous()


def rotation_matrices(directions: Tensor) -> Tensor:
    """Rotation matrices of quaternions (w, x, y, z) of length 1. [4, N] -> [3, 3, N]"""
    w, x, y, z = directions
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows).view(3, 3, -1)


def _rotate(W: Tensor, rows: Sequence[Tensor] | Tensor) -> list[Tensor]:
    """W times three rows of any shape. Not a call to BLAS, whose precision autocast and global settings lower."""
    return [W[i, 0] * rows[0] + W[i, 1] * rows[1] + W[i, 2] * rows[2] for i in range(3)]


def _to_screen(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int
) -> _Screen:
    """The equations of the module docstring for one camera: means [n, 3], quats [n, 4], scales [n, 3]."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    W, t = viewmat[:3, :3], viewmat[:3, 3]

    px, py, pz = (p + shift for p, shift in zip(_rotate(W, means.t().contiguous()), t, strict=True))  # each [n]
    slopes = px / pz, py / pz
    means2d = torch.stack([fx * slopes[0] + cx, fy * slopes[1] + cy])

    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    u = slopes[0].clamp(-(cx / fx + margin_x), (width - cx) / fx + margin_x)
    v = slopes[1].clamp(-(cy / fy + margin_y), (height - cy) / fy + margin_y)

    unit = directions(quats)
    rotations = rotation_matrices(unit)
    right, down, forward = axes = _rotate(W, rotations * scales.t())
    a0, a1 = (fx / pz) * (right - u * forward), (fy / pz) * (down - v * forward)

    xx, xy, yy = (a0 * a0).sum(0), (a0 * a1).sum(0), (a1 * a1).sum(0)
    normal = torch.linalg.cross(a0, a1, dim=0)
    det = normal.square().sum(0)
    det_blurred = det + EPS2D * (xx + yy) + EPS2D**2
    blurred = xx + EPS2D, xy, yy + EPS2D
    return _Screen(means2d, pz, blurred, det, det_blurred, slopes, (u, v), unit, rotations, axes, (a0, a1), normal)


def _radii(screen: _Screen) -> Tensor:
    """Three standard deviations along the longer axis, rounded up: ceil(3 sqrt(lambda_max)). [n]"""
    xx, xy, yy = screen.blurred
    spread = torch.hypot(0.5 * (xx - yy), xy)  # no square, which would overflow from 4e9 pixels
    longest = 0.5 * (xx + yy) + spread.clamp(min=math.sqrt(MIN_DISCRIMINANT))
    return (RADIUS_SIGMAS * longest.sqrt()).ceil()


def _conics(screen: _Screen) -> Tensor:
    """Upper triangle of the inverse of the blurred covariance. [n, 3]"""
    xx, xy, yy = screen.blurred
    return torch.stack([yy, -xy, xx], dim=-1) / screen.det_blurred[:, None]


def _compensations(screen: _Screen) -> Tensor:
    """sqrt(det / det_blurred). Both overflow for a splat of 1e10 pixels, of which the blur is no part: 1. [n]"""
    det, det_blurred = (d.clamp(max=torch.finfo(d.dtype).max) for d in (screen.det, screen.det_blurred))
    return (det / det_blurred).sqrt()


def _visible(screen: _Screen, radii: Tensor, width: int, height: int, options: ProjectionOptions) -> Tensor:
    """Whether each splat is between the planes and touches the image; False if its projection is not finite. [n]"""
    x, y = screen.means2d
    visible = (screen.depths >= options.near_plane) & (screen.depths <= options.far_plane)
    visible &= (screen.det_blurred > 0) & (radii > 0) & (radii < LARGEST_RADIUS)
    return visible & (x + radii > 0) & (x - radii < width) & (y + radii > 0) & (y - radii < height)


def project(geometry: tuple[Tensor, ...], cameras: tuple, options: ProjectionOptions) -> Projection:
    """See `nrfgs_ns.rasterizer.project`: means, quats, scales; viewmats, Ks, width, height."""
    viewmats, Ks, width, height = cameras
    cameras = zip(viewmats, Ks, strict=True)
    projected = [ProjectSplats.apply(*geometry, *camera, (width, height), options) for camera in cameras]
    ids, *columns, compensations = (torch.cat(rows) for rows in zip(*projected, strict=True))
    camera_ids = torch.cat([torch.full_like(camera[0], index) for index, camera in enumerate(projected)])
    if options.rasterize_mode != "antialiased":
        compensations = None
    return Projection(camera_ids, ids, *columns, compensations, width, height, n_cameras=len(viewmats))


class ProjectSplats(torch.autograd.Function):
    """(means, quats, scales, viewmat) of one camera -> ids, radii, and means2d, depths, conics, compensations.

    Visibility is decided for all splats; the backward pass looks at the visible ones only, so that a culled splat can
    never send a NaN back.
    """

    @staticmethod
    def forward(ctx, means, quats, scales, viewmat, K, size: tuple[int, int], options: ProjectionOptions):
        screen = _to_screen(means, quats, scales, viewmat, K, *size)
        radii = _radii(screen)
        ids = _visible(screen, radii, *size, options).nonzero().squeeze(1)
        ctx.save_for_backward(means, quats, scales, viewmat, K, ids)
        ctx.size = size
        radii = radii.index_select(0, ids).clamp(max=MAX_RADIUS).to(torch.int32)
        ctx.mark_non_differentiable(ids, radii)
        projected = screen.means2d.t(), screen.depths, _conics(screen), _compensations(screen)
        return ids, radii, *(rows.index_select(0, ids) for rows in projected)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, _ids, _radii, d_means2d, d_depths, d_conics, d_compensations):
        means, quats, scales, viewmat, K, ids = ctx.saved_tensors
        seen = [table.index_select(0, ids) for table in (means, quats, scales)]
        screen = _to_screen(*seen, viewmat, K, *ctx.size)
        d_position, d_axes = _back_to_camera(screen, K, d_means2d, d_depths, d_conics, d_compensations)
        W = viewmat[:3, :3]
        d_means = torch.stack(_rotate(W.t(), d_position), -1)
        scaled = seen[2].t()
        d_local = torch.stack(_rotate(W.t(), d_axes))  # of R_q diag(s). [3, 3, n]
        d_scales = (d_local * screen.rotations).sum(0).t()
        d_quats = _back_to_quats(screen, d_local * scaled, seen[1])
        tables = zip((means, quats, scales), (d_means, d_quats, d_scales), strict=True)
        d_tables = [torch.zeros_like(table).index_copy_(0, ids, rows) for table, rows in tables]
        d_viewmat = None
        if ctx.needs_input_grad[3]:
            d_viewmat = torch.zeros_like(viewmat)
            local = screen.rotations * scaled
            for i in range(3):
                d_viewmat[i, :3] = (d_position[i][:, None] * seen[0]).sum(0) + (d_axes[i] * local).sum((1, 2))
                d_viewmat[i, 3] = d_position[i].sum()
        return *d_tables, d_viewmat, None, None, None


def _back_to_camera(
    screen: _Screen, K: Tensor, d_means2d: Tensor, d_depths: Tensor, d_conics: Tensor, d_compensations: Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Gradients of the camera-space position p, [n] each, and of the rows of W R_q diag(s), [3, n] each."""
    fx, fy = K[0, 0], K[1, 1]
    z, (u, v), (a0, a1) = screen.depths, screen.clamped, screen.rows
    right, down, forward = screen.axes

    d_conics = (d_conics / screen.det_blurred[:, None]).t().contiguous()
    d_yy, d_xy, d_xx = d_conics[0], -d_conics[1], d_conics[2]
    # The slope of the root is bounded as in gsplat, 1 / (2 (sqrt(x) + 1e-6)): finite where a flat splat has x = 0.
    root = _compensations(screen)
    d_ratio = (d_compensations * 0.5 / (root + COMPENSATION_EPS)) / screen.det_blurred
    d_inverse = -(d_conics * _conics(screen).t()).sum(0)
    # det(cov2d) counts by itself and as a part of det(cov2d + e I). The two nearly cancel for a large splat: their
    # difference, 1 - root^2, is written as the blur's part of the determinant.
    xx, _, yy = screen.blurred
    d_det = d_inverse + d_ratio * (EPS2D * (xx + yy - EPS2D) / screen.det_blurred)
    d_trace = EPS2D * (d_inverse - d_ratio * root * root)
    d_xx, d_yy = d_xx + d_trace, d_yy + d_trace

    d_normal = 2 * d_det * screen.normal
    d_a0 = torch.linalg.cross(a1, d_normal, dim=0) + 2 * d_xx * a0 + d_xy * a1
    d_a1 = torch.linalg.cross(d_normal, a0, dim=0) + 2 * d_yy * a1 + d_xy * a0
    d_z = d_depths - ((d_a0 * a0).sum(0) + (d_a1 * a1).sum(0)) / z
    d_right, d_down = (fx / z) * d_a0, (fy / z) * d_a1
    d_forward = -(u * d_right + v * d_down)

    d_slopes = []
    for axis, (f, clamped_slope, d_axis) in enumerate(((fx, u, d_right), (fy, v, d_down))):
        unclamped = clamped_slope == screen.slopes[axis]
        d_slopes.append(f * d_means2d[:, axis] - (d_axis * forward).sum(0).where(unclamped, 0.0))
    d_x, d_y = (d_slope / z for d_slope in d_slopes)
    d_z = d_z - d_x * screen.slopes[0] - d_y * screen.slopes[1]
    return (d_x, d_y, d_z), (d_right, d_down, d_forward)


def _back_to_quats(screen: _Screen, d_rotations: Tensor, quats: Tensor) -> Tensor:
    """Gradients of the quaternions [n, 4] from those of their rotation matrices [3, 3, n]."""
    w, x, y, z = screen.directions
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = d_rotations
    d_unit = 2 * torch.stack(
        [
            x * (r21 - r12) + y * (r02 - r20) + z * (r10 - r01),
            w * (r21 - r12) + y * (r01 + r10) + z * (r02 + r20) - 2 * x * (r11 + r22),
            w * (r02 - r20) + x * (r01 + r10) + z * (r12 + r21) - 2 * y * (r00 + r22),
            w * (r10 - r01) + x * (r02 + r20) + y * (r12 + r21) - 2 * z * (r00 + r11),
        ]
    )
    tangent = d_unit - screen.directions * (screen.directions * d_unit).sum(0)
    return tangent.t() / quats.norm(dim=-1, keepdim=True)
