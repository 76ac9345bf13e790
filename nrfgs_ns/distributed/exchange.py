# SPDX-License-Identifier: Apache-2.0
"""Projected splats travel to the device that owns the camera; gradients travel back.

Each (camera, visible splat) pair is one row of numbers: place, shape, depth, radius, opacity and colour.
Autograd carries the gradient of each number back to the row that it came from, except `absgrad`, the sum over pixels of
|dL/dmean2d| that some densifications use. The compositor leaves it beside the gradients, on the camera's device, and it
is sent along with them.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.distributed import comm
from nrfgs_ns.rasterizer import Projection


@dataclass
class AbsgradPost:
    """Where the backward pass finds `absgrad` and where it leaves it."""

    owned: Tensor
    """means2d as projected on the device of the splats, [M, 2]"""
    arrived: Tensor | None = None
    """means2d as the compositor got it, on the device of the camera; released by the backward pass"""


class _Swap(torch.autograd.Function):
    """`comm.swap` of rows [M, 11], whose gradient is swapped back."""

    @staticmethod
    def forward(ctx, rows: Tensor, sent: list[int], received: list[int], post: AbsgradPost | None) -> Tensor:
        ctx.sent, ctx.received, ctx.post = sent, received, post
        return comm.swap(rows, sent, received)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):
        width = gradient.shape[1]
        if ctx.post is not None:
            absgrad = getattr(ctx.post.arrived, "absgrad", None)  # a compositor without rows leaves none
            gradient = torch.cat([gradient, gradient.new_zeros(len(gradient), 2) if absgrad is None else absgrad], 1)
            ctx.post.arrived = None
        gradient = comm.swap(gradient, ctx.received, ctx.sent)
        if ctx.post is not None:
            ctx.post.owned.absgrad = gradient[:, width:].contiguous()
        return gradient[:, :width], None, None, None


def send_to_cameras(
    projection: Projection, appearance: SplatAppearance, width: int, height: int, absgrad: bool
) -> tuple[Projection, SplatAppearance]:
    """Send each camera's device what this device's splats look like from there, and receive what others see from ours.

    Args:
        projection: this device's splats in all W cameras, camera i being device i's; M rows.
        width, height: size of this device's own camera, pixels.
        absgrad: let the backward pass leave `projection.means2d.absgrad`, [M, 2].

    Returns:
        This device's own camera, as `rasterizer.composite` wants it: rows by device, then by splat. Opacities are
        compensated already. `gaussian_ids` counts the rows: the splats live elsewhere.
    """
    cameras = torch.arange(comm.world() + 1, device=projection.camera_ids.device)
    sent, received = comm.swap_counts(torch.searchsorted(projection.camera_ids, cameras).diff())
    opacities = appearance.opacities
    if projection.compensations is not None:
        opacities = opacities * projection.compensations
    # Radii travel as floating point, exact up to 2^24 pixels.
    scalars = [column[:, None] for column in (projection.depths, opacities, projection.radii)]
    columns = [projection.means2d, projection.conics, *scalars, appearance.colors]
    columns = [column.to(projection.means2d.dtype) for column in columns]
    post = AbsgradPost(projection.means2d) if absgrad else None
    rows = _Swap.apply(torch.cat(columns, dim=1), sent, received, post)
    means2d, conics, depths, opacities, radii, colors = rows.split([column.shape[1] for column in columns], dim=1)
    means2d = means2d.contiguous()  # the kernels would make a copy, and leave absgrad with it
    if post is not None:
        post.arrived = means2d
    own = Projection(
        camera_ids=torch.zeros(len(rows), dtype=torch.int64, device=rows.device),
        gaussian_ids=torch.arange(len(rows), device=rows.device),
        radii=radii.detach().squeeze(1).to(torch.int32),
        means2d=means2d,
        depths=depths.squeeze(1).contiguous(),
        conics=conics.contiguous(),
        compensations=None,
        width=width,
        height=height,
        n_cameras=1,
    )
    return own, SplatAppearance(colors.contiguous(), opacities.squeeze(1).contiguous())
