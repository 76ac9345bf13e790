# SPDX-License-Identifier: Apache-2.0
"""The CPU back end: `projection`, `tiles`, `compositing`, in this order. Their float64 twin lives with the tests."""

import torch
from torch import Tensor

from nrfgs_ns.rasterizer import Projection, ProjectionOptions

from .compositing import CompositeSplats
from .projection import ProjectSplats


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


def leaves_out(*_) -> bool:
    """Whether `composite` can leave out rows that are not finite."""
    return False


def composite(
    projection: Projection, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None, absgrad: bool, _: bool
) -> tuple[Tensor, Tensor, dict]:
    """Render [C, H, W, D] over backgrounds [C, D], alphas [C, H, W, 1], and no lists to add to `info`."""
    tables = projection.means2d, projection.conics, opacities, colors
    render, transmittance = CompositeSplats.apply(*tables, projection, absgrad)
    if backgrounds is not None:
        render = render + transmittance * backgrounds[:, None, None, :]
    return render, 1 - transmittance, {}
