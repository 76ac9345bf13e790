# SPDX-License-Identifier: Apache-2.0
"""Rendering as functions of values: geometry -> appearance -> rasterizer -> image.

view = project_view(field.splats, pinhole, options)            # which splats, and where
appearance = field.seen_from(view)                             # their colours and opacities (`appearance/field.py`)
outputs, info = composite_view(view, appearance, background)   # the image

`render_view` is the last two as a model is configured.
"""

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.data.checks import warn
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.model.pinhole import Pinhole
from nrfgs_ns.rasterizer import Projection, ProjectionOptions, RasterizeMode, composite, project

NEAR_PLANE, FAR_PLANE = 0.01, 1e10
"""Depths between which splats are drawn, in scene units: splatfacto's."""
ROWS = "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "n_cameras"
"""What densification reads in `info` about a view's rows."""
LOOK = "NRFGS_LOOK"
"""Environment variable: a training photograph's file name; without it, renderings have the photographs' mean look."""


def projection_options(
    rasterize_mode: RasterizeMode, scene_unit: float, near: float = 0.0, *, assume_finite: bool = False
) -> ProjectionOptions:
    """Options of a projection with splatfacto's planes, `scene_unit` being the world units in a scene unit. The near
    plane is at least `near` world units away."""
    planes = max(NEAR_PLANE * scene_unit, near), FAR_PLANE * scene_unit
    return ProjectionOptions(rasterize_mode, *planes, assume_finite=assume_finite)


class View(NamedTuple):
    """Splats seen by one camera."""

    projection: Projection
    """the visible splats on the image plane, M of them"""
    center: Tensor
    """camera centre in world coordinates, [3]; of several cameras, each row's, [M, 3]"""
    every_row: bool = False
    """invisible splats have rows, too (`ProjectionOptions.every_row`)"""
    pinhole: Pinhole | None = None
    """the camera; None: the splats are those of several"""

    @property
    def visible(self) -> Tensor:
        """Rows of the table that are visible, int64 [M]."""
        return self.projection.gaussian_ids


def project_splats(
    splats: Mapping[str, Tensor], viewmats: Tensor, Ks: Tensor, width: int, height: int, options: ProjectionOptions
) -> Projection:
    """Project a table of splats ("scales" are logarithms) into cameras [C, 4, 4], [C, 3, 3] of one size."""
    geometry = splats["means"], splats["quats"], splats["scales"].exp()
    return project(*geometry, viewmats, Ks, width, height, options)


def project_view(splats: Mapping[str, Tensor], pinhole: Pinhole, options: ProjectionOptions) -> View:
    """Project a table of splats into one camera."""
    *camera, center = pinhole
    return View(project_splats(splats, *camera, options), center, options.every_row, pinhole)


def composite_view(
    view: View,
    appearance: SplatAppearance,
    background: Tensor,
    *,
    with_depth: bool = True,
    absgrad: bool = False,
    assume_finite: bool = False,
    image_of: Callable[[Tensor, Tensor], Tensor] | None = None,
    look: Callable[[Tensor], Tensor] | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Composite the visible splats over a background.

    Args:
        view: M visible splats.
        appearance: their colours and opacities.
        background: a colour [3].
        with_depth: return depth, too.
        absgrad, assume_finite: as in `rasterizer.composite`.
        image_of: of a head at the pixel (`AppearanceHead`). Features are composited over zero, and their image is drawn
            over the background, as opaque as the splats are. None: colours are the image's.
        look: the photograph's exposure model, applied to the rendered image [H, W, 3]; None: clamp it to [0, 1].

    Returns:
        "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [H, W, 3], and "depth" [H, W, 1] if wanted;
        and the rasterizer's `info`, for densification.
    """
    render, alpha, info = composite(
        view.projection,
        appearance.colors,
        appearance.opacities,
        backgrounds=background[None] if image_of is None else None,
        with_depth=with_depth,
        absgrad=absgrad,
        assume_finite=assume_finite,
    )
    render, alpha = render.squeeze(0), alpha.squeeze(0)  # the gradient of [0] would be a copy among zeros
    rgb = render[..., :-1] if with_depth else render
    if image_of is not None:
        rgb = alpha * image_of(rgb, view.pinhole.rays()) + (1.0 - alpha) * background
    outputs = {
        "rgb": torch.clamp(rgb, 0.0, 1.0) if look is None else look(rgb),
        "accumulation": alpha,
        "background": background.expand(*alpha.shape[:2], 3),
    }
    if with_depth:
        depth = render[..., -1:]
        outputs["depth"] = torch.where(alpha > 0, depth, depth.detach().max())
    return outputs, info


def render_view(
    model,
    view: View,
    field: Field,
    noise: torch.Generator | None,
    look: Callable[[Tensor], Tensor] | None,
    exchange: Callable[[View, SplatAppearance], tuple[View, SplatAppearance]] | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Render a view of a field as an NrfgsModel is configured: in evaluation, in the eager and the recorded step, and
    on each of several devices. In training, densification looks at it. `info` is about the view's rows.

    Args:
        view: the field's splats in a camera; with `exchange`, in those of all devices.
        noise: generator of the noise under which the head sees the splats (`view_noise.py`); None: no noise.
        look: as in `composite_view`.
        exchange: this device's splats in all cameras -> all devices' splats in its own camera.
    """
    seen = field._replace(splats=model.view_noise.moved(field.splats, noise))
    appearance = seen.seen_from(view)
    drawn = (view, appearance) if exchange is None else exchange(view, appearance)
    outputs, info = composite_view(*drawn, model._get_background_color(), look=look, **model.compositing)
    if exchange is not None:  # the image's rows are other devices' splats
        info = {name: getattr(view.projection, name) for name in ROWS}
    if model.training:
        shown, stored = appearance.opacities, field.splats["opacities"]
        if view.every_row:
            base = torch.sigmoid(stored).flatten()  # for splats that are not visible
            shown = torch.where(info["radii"] > 0, shown, base)
        model.densification.pre_backward(model.step, info, shown, stored)
    return outputs, info


def look_asked_for(photograph: PhotographModel | None) -> int | None:
    """The index of the photograph that LOOK names, whose exposure and colour renderings outside of training take; None,
    with a warning, if no exposures have been learnt.

    Raises:
        InputError: there is no such photograph.
    """
    name = os.environ.get(LOOK)
    if not name:
        return None
    if photograph is None:
        warn(f"{LOOK} is {name!r}, but this model has learnt no photograph's exposure: all renderings have one look.")
        return None
    if name not in photograph.names:
        raise InputError(f"{LOOK} is {name!r}, which is not a training photograph, such as {photograph.names[0]!r}.")
    return photograph.names.index(name)
