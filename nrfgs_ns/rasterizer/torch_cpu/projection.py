# SPDX-License-Identifier: Apache-2.0
"""Projection: 3D splats to 2D splats (EWA splatting, Zwicker et al. 2001), with the conventions of gsplat 1.4.

A splat with mean x, rotation R_q and scales s is seen by a camera with rotation W and translation t at

    p = W x + t,        mean2d = (f_x p_x / p_z + c_x,  f_y p_y / p_z + c_y).

Its covariance is R_q diag(s^2) R_q^T. The camera flattens it with the Jacobian J of the perspective map, so that

    cov2d = A A^T,      A = J W R_q diag(s)  (2 x 3),      J = [ f_x / p_z    0            -f_x u / p_z ]
                                                               [ 0            f_y / p_z    -f_y v / p_z ]

where (u, v) = (p_x, p_y) / p_z, held within 0.3 tan(fov / 2) beyond the image edges: the linearisation is useless
further out. A blur of `eps2d` square pixels keeps every splat at least a pixel wide: cov2d + eps2d I.

Two determinants decide everything that follows, and both are differences of large numbers for a needle. Written with
the rows a_0, a_1 of A they are not:

    det(cov2d)           = |a_0 x a_1|^2
    det(cov2d + eps2d I) = det(cov2d) + eps2d trace(cov2d) + eps2d^2.

All arrays hold one row per coordinate and one column per splat: each line below is one pass over memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..contract import Projection

FOV_MARGIN = 0.3  # how far beyond the image edge J may be evaluated, in units of tan(fov / 2)
RADIUS_SIGMAS = 3.0  # a splat ends at this many standard deviations
# Floor under the square root of the eigenvalue formula, in pixel^4. gsplat's two projection kernels differ in it.
MIN_DISCRIMINANT_PACKED, MIN_DISCRIMINANT_DENSE = 0.1, 0.01
COMPENSATION_EPS = 1e-6  # bounds the slope of sqrt at 0 in the backward pass
MAX_RADIUS = float(2**30)  # in pixels: representable in int32 and far beyond every image
LARGEST_RADIUS = float(2**63)  # in pixels: products of two lengths on the image plane stay below float32's 2^128
MIN_QUATERNION = 1e-15  # the derivative of normalising goes through 1 / |q|^2, which must stay far below 2^128


class _Screen(NamedTuple):
    """Splats on the image plane of one camera; n splats."""

    means2d: Tensor  # [2, n]
    depths: Tensor  # [n]
    blurred: tuple[Tensor, Tensor, Tensor]  # xx, xy, yy of cov2d + eps2d I, [n] each
    det: Tensor  # det(cov2d), [n]
    det_blurred: Tensor  # det(cov2d + eps2d I), [n]


class _BoundedSlopeSqrt(torch.autograd.Function):
    """sqrt(x) whose derivative is 1 / (2 (sqrt(x) + 1e-6)), as in gsplat: finite where a flat splat has x = 0."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        root = x.sqrt()
        ctx.save_for_backward(root)
        return root

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (root,) = ctx.saved_tensors
        return grad * 0.5 / (root + COMPENSATION_EPS)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions (w, x, y, z). [N, 4] -> [3, 3, N]

    NaN for a quaternion shorter than MIN_QUATERNION, or so long that its square overflows: it has no direction.
    """
    squared = quats.square().sum(-1, keepdim=True)
    squared = squared.masked_fill((squared < MIN_QUATERNION**2) | squared.isinf(), math.nan)
    # Not rsqrt, whose derivative is its third power: infinite for a quaternion of length 1e-13 already.
    w, x, y, z = (quats / squared.sqrt()).t().contiguous()
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows).view(3, 3, -1)


def _rotate(W: Tensor, rows: Tensor) -> list[Tensor]:
    """W times three rows of any shape. Not a call to BLAS, whose precision autocast and global settings lower."""
    return [W[i, 0] * rows[0] + W[i, 1] * rows[1] + W[i, 2] * rows[2] for i in range(3)]


def _to_screen(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, eps2d: float
) -> _Screen:
    """The equations of the module docstring for one camera: means [n, 3], quats [n, 4], scales [n, 3]."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    W, t = viewmat[:3, :3], viewmat[:3, 3]

    px, py, pz = (p + shift for p, shift in zip(_rotate(W, means.t().contiguous()), t, strict=True))  # each [n]
    u, v = px / pz, py / pz
    means2d = torch.stack([fx * u + cx, fy * v + cy])

    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    u = u.clamp(-(cx / fx + margin_x), (width - cx) / fx + margin_x)
    v = v.clamp(-(cy / fy + margin_y), (height - cy) / fy + margin_y)

    right, down, forward = _rotate(W, rotation_matrices(quats) * scales.t())  # rows of W R_q diag(s), [3, n] each
    a0 = (fx / pz) * (right - u * forward)
    a1 = (fy / pz) * (down - v * forward)

    xx, xy, yy = (a0 * a0).sum(0), (a0 * a1).sum(0), (a1 * a1).sum(0)
    det = torch.linalg.cross(a0, a1, dim=0).square().sum(0)
    det_blurred = det + eps2d * (xx + yy) + eps2d**2
    return _Screen(means2d, pz, (xx + eps2d, xy, yy + eps2d), det, det_blurred)


def _radii(screen: _Screen, min_discriminant: float) -> Tensor:
    """Three standard deviations along the longer axis, rounded up: ceil(3 sqrt(lambda_max)). [n]"""
    xx, xy, yy = screen.blurred
    spread = torch.hypot(0.5 * (xx - yy), xy)  # no square, which would overflow from 4e9 pixels
    longest = 0.5 * (xx + yy) + spread.clamp(min=math.sqrt(min_discriminant))
    return (RADIUS_SIGMAS * longest.sqrt()).ceil()


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    rasterize_mode: str = "classic",
    packed: bool = True,
    assume_finite: bool = False,
) -> Projection:
    """Find the visible splats of each camera and project them; see `nrfgs_ns.rasterizer.project`.

    Visibility is decided first, without gradients, for all splats; the differentiable pass then runs on the visible
    ones only, so that a culled splat can never send a NaN back. A splat is visible when near <= depth <= far, its
    radius exceeds `radius_clip`, and its square touches the image. A splat whose projection is not finite (a zero
    quaternion, an infinite scale, a NaN anywhere) fails these comparisons and is invisible, for nothing: here
    `assume_finite` saves no work and changes nothing.
    """
    min_discriminant = MIN_DISCRIMINANT_PACKED if packed else MIN_DISCRIMINANT_DENSE
    per_camera = []
    for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        with torch.no_grad():
            screen = _to_screen(means, quats, scales, viewmat, K, width, height, eps2d)
            radii = _radii(screen, min_discriminant)
            x, y = screen.means2d
            visible = (screen.depths >= near_plane) & (screen.depths <= far_plane)
            visible &= (screen.det_blurred > 0) & (radii > radius_clip) & (radii < LARGEST_RADIUS)
            visible &= (x + radii > 0) & (x - radii < width) & (y + radii > 0) & (y - radii < height)
            ids = visible.nonzero().squeeze(1)

        seen = (table.index_select(0, ids) for table in (means, quats, scales))
        screen = _to_screen(*seen, viewmat, K, width, height, eps2d)
        xx, xy, yy = screen.blurred
        conics = torch.stack([yy, -xy, xx], dim=-1) / screen.det_blurred[:, None]
        rows = [
            torch.full_like(ids, camera),
            ids,
            radii.index_select(0, ids).clamp(max=MAX_RADIUS).to(torch.int32),
            screen.means2d.t(),
            screen.depths,
            conics,
        ]
        if rasterize_mode == "antialiased":
            # Both overflow for a splat of 1e10 pixels, of which the blur is no part: the factor is 1.
            det, det_blurred = (d.clamp(max=torch.finfo(d.dtype).max) for d in (screen.det, screen.det_blurred))
            rows.append(_BoundedSlopeSqrt.apply(det / det_blurred))
        per_camera.append(rows)

    columns = [torch.cat(column) for column in zip(*per_camera, strict=True)]
    compensations = columns.pop() if rasterize_mode == "antialiased" else None
    return Projection(*columns, compensations=compensations, width=width, height=height, n_cameras=len(viewmats))
