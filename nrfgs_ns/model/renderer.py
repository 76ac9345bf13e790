# SPDX-License-Identifier: Apache-2.0
"""How a camera is rendered, as functions of values: geometry -> appearance -> rasterizer -> image.

    view = project_view(field.splats, pinhole, options)            # which splats, and where
    appearance = field.seen_from(view)                             # their colours and opacities (`appearance/field.py`)
    outputs, info = composite_view(view, appearance, background)   # the image

Nothing here needs CUDA.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.model.pinhole import Pinhole
from nrfgs_ns.rasterizer import Projection, ProjectionOptions, RasterizeMode, composite, project

NEAR_PLANE, FAR_PLANE = 0.01, 1e10
"""Depths between which splats are drawn, in scene units: splatfacto's."""


def projection_options(
    rasterize_mode: RasterizeMode, scene_unit: float, near: float = 0.0, *, assume_finite: bool = False
) -> ProjectionOptions:
    """Options of a projection whose planes are splatfacto's, in scene units of `scene_unit` world units, or whose near
    plane is farther, `near` world units away."""
    planes = max(NEAR_PLANE * scene_unit, near), FAR_PLANE * scene_unit
    return ProjectionOptions(rasterize_mode, *planes, assume_finite=assume_finite)


class View(NamedTuple):
    """One camera, and what it sees of a table of splats."""

    projection: Projection
    """the visible splats on the image plane, M of them"""
    center: Tensor
    """camera centre in world coordinates, [3]"""

    @property
    def visible(self) -> Tensor:
        """Rows of the table that are visible, int64 [M]."""
        return self.projection.gaussian_ids


def project_splats(
    splats: Mapping[str, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    options: ProjectionOptions = ProjectionOptions(),  # noqa: B008
) -> Projection:
    """Project a table of splats ("scales" are logarithms) into cameras [C, 4, 4], [C, 3, 3] of one size."""
    geometry = splats["means"], splats["quats"], splats["scales"].exp()
    return project(*geometry, viewmats, Ks, width, height, options)


def project_view(
    splats: Mapping[str, Tensor],
    pinhole: Pinhole,
    options: ProjectionOptions = ProjectionOptions(),  # noqa: B008
) -> View:
    """Project a table of splats into one camera."""
    projection = project_splats(splats, pinhole.viewmat, pinhole.K, pinhole.width, pinhole.height, options)
    return View(projection, pinhole.center)


def composite_view(
    view: View,
    appearance: SplatAppearance,
    background: Tensor,
    *,
    with_depth: bool = True,
    absgrad: bool = False,
    assume_finite: bool = False,
    look: Callable[[Tensor], Tensor] | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Composite the visible splats over a background.

    Args:
        view: what one camera sees.
        appearance: colours and opacities of the M visible splats.
        background: a colour [3].
        with_depth: whether depth is wanted, too.
        absgrad: as in `rasterizer.composite`.
        assume_finite: colours and opacities that are not finite need not be looked for.
        look: what a photograph makes of the picture [H, W, 3], whose colours are not cut off; in [0, 1].

    Returns:
        "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [H, W, 3], and "depth" [H, W, 1] if wanted;
        and the rasterizer's `info`, for densification.
    """
    render, alpha, info = composite(
        view.projection,
        appearance.colors,
        appearance.opacities,
        backgrounds=background[None],
        with_depth=with_depth,
        absgrad=absgrad,
        assume_finite=assume_finite,
    )
    render, alpha = render.squeeze(0), alpha.squeeze(0)  # a view; what [0] sends back is a copy among zeros
    rgb = render[..., :3] if with_depth else render
    outputs = {
        "rgb": torch.clamp(rgb, 0.0, 1.0) if look is None else look(rgb),
        "accumulation": alpha,
        "background": background.expand(*alpha.shape[:2], 3),
    }
    if with_depth:
        depth = render[..., 3:4]
        outputs["depth"] = torch.where(alpha > 0, depth, depth.detach().max())
    return outputs, info
