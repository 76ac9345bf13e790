# SPDX-License-Identifier: Apache-2.0
"""What can be shown of an appearance head: one camera rendered in one of several modes.

`picture` needs no viewer: `training/tracking.py` logs the same pictures.

Modes, beside those that the head itself offers (`AppearanceHead.components`):

    full              the image, with the gain's share of the residual: base + gain (trained - base), for colours and
                      opacities alike
    base colour       base colours with base opacities, as if the gain were 0
    view dependence   how much a splat's colour varies with the direction (`view_dependence`)
    depth             expected depth, dark near and bright far

Changes of colour or opacity are drawn around grey, AMPLIFICATION times as large; weights in viridis, dark to bright.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.colormaps import apply_float_colormap
from torch import Tensor

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import Component, SplatAppearance
from nrfgs_ns.image.photograph import exposed
from nrfgs_ns.rasterizer import composite

if TYPE_CHECKING:
    from nrfgs_ns.model.model import NrfgsModel
    from nrfgs_ns.model.renderer import View

FULL, BASE, VIEW_DEPENDENCE, DEPTH = "full", "base colour", "view dependence", "depth"

GREY = 0.5
"""Where a change is drawn that is none."""
AMPLIFICATION = 4.0
"""How much larger than life a change is drawn: the whole range of colours is used up by a change of 1/8 of white, a
little over half of the field's bound of 0.2."""
OPACITY_AXIS = (1.0, 0.0, -1.0)
"""The colour of a change of opacity: orange where the splat is more opaque than its base, blue where it is less."""
FULL_DEVIATION = 0.1
"""The standard deviation of colour that is drawn brightest: a residual of +0.1 from half of all directions and -0.1
from the others."""
FAR_QUANTILE = 0.98
"""Share of the drawn pixels that set the range of depths, so that one floater does not flatten all else."""

LEGENDS = {
    FULL: "The image as trained, with the residual times the gain.",
    BASE: "Base colours and base opacities: what does not depend on the view.",
    VIEW_DEPENDENCE: f"Deviation of a splat's colour over 12 directions: dark 0, bright {FULL_DEVIATION:g} or more.",
    DEPTH: "Expected depth: dark near, bright far.",
    "color": f"Grey: no change of colour. Otherwise the change times the gain, times {AMPLIFICATION:g}.",
    "opacity": f"Grey: no change. Orange: more opaque, blue: less; times the gain, times {AMPLIFICATION:g}.",
    "weight": "Dark 0, bright 1.",
}
"""What a mode, or a component's kind, shows: the line under the panel's dropdown."""


@dataclass(frozen=True)
class Shown:
    """What a picture shows."""

    mode: str = FULL
    """one of `modes(head)`"""
    gain: float = 1.0
    """factor of the residuals, >= 0; 1 is as trained."""
    frozen_center: Tensor | None = None
    """where splats are seen from [3], in world units, if that is not where the camera is"""
    stops: float = 0.0
    """by how much the image is exposed more"""
    photograph: int | None = None
    """the training photograph whose exposure and colour the image has; None: the mean look"""


def offered_components(field: Field) -> dict[str, str]:
    """What a head can show of itself: name -> kind, asked with no splats."""
    means = field.splats["means"]
    none = torch.zeros(0, dtype=torch.int64, device=means.device)
    with torch.no_grad():
        components = field.head.components(field.splats, none, means.new_zeros(3))
    return {name: component.kind for name, component in components.items()}


def modes(field: Field) -> list[str]:
    """All modes in which a field can be shown."""
    return [FULL, BASE, *offered_components(field), VIEW_DEPENDENCE, DEPTH]


@torch.no_grad()
def picture(model: "NrfgsModel", camera: Cameras, shown: Shown, background: Tensor | None = None) -> dict[str, Tensor]:
    """Render one camera in one mode.

    Args:
        model: in evaluation mode.
        camera: a batch of one camera, [1].
        background: a colour [3] behind the splats instead of the configuration's.

    Returns:
        What the model's `get_outputs` returns, with "rgb" [H, W, 3] in [0, 1] showing what was asked for. Accumulation
        and depth are those of the image with its gain, or of the base for the base colour.

    Raises:
        ValueError: the head does not offer the mode.
    """
    field = model.field
    view = model.project(camera, field.splats)
    if shown.frozen_center is not None:
        view = view._replace(center=shown.frozen_center.to(view.center))
    appearance = with_gain(field, view, 0.0 if shown.mode == BASE else shown.gain)
    outputs, _ = model.composite(view, appearance, background, shown.photograph)
    if shown.mode in (FULL, BASE):
        if shown.stops != 0.0:
            outputs["rgb"] = exposed(outputs["rgb"], shown.stops)
        return outputs

    if shown.mode == DEPTH:
        share = scaled_depth(outputs["depth"], outputs["accumulation"])
    elif shown.mode == VIEW_DEPENDENCE:
        deviation = view_dependence(field, view)
        share = _blend(view, deviation / FULL_DEVIATION, appearance.opacities, outputs["accumulation"])
    else:
        components = field.components_of(view)
        if shown.mode not in components:
            raise ValueError(
                f"The {model.head.name!r} head does not show {shown.mode!r}; it offers "
                f"{', '.join(map(repr, modes(field)))}."
            )
        component = components[shown.mode]
        if component.kind != "weight":
            drawn = GREY + AMPLIFICATION * shown.gain * _as_colors(component)
            outputs["rgb"] = _over_grey(view, drawn, appearance.opacities, outputs["accumulation"])
            return outputs
        share = _blend(view, component.values, appearance.opacities, outputs["accumulation"])
    accumulation, behind = outputs["accumulation"], outputs["background"]
    outputs["rgb"] = accumulation * apply_float_colormap(share.clamp(0.0, 1.0), "viridis") + (1 - accumulation) * behind
    return outputs


def with_gain(field: Field, view: "View", gain: float) -> SplatAppearance:
    """The appearance of the visible splats with `gain` times what the head adds to their base appearance.

    At gain 1 this is the head's own answer, to the bit; at 0 the base appearance.
    """
    if gain == 1.0:
        return field.seen_from(view)
    base = field.base_of(view)
    if gain == 0.0:
        return base
    trained = field.seen_from(view)
    return SplatAppearance(
        colors=(base.colors + gain * (trained.colors - base.colors)).clamp_min(0.0),
        opacities=(base.opacities + gain * (trained.opacities - base.opacities)).clamp(0.0, 1.0),
    )


def icosahedron() -> Tensor:
    """Unit vectors to the 12 corners of an icosahedron, [12, 3].

    They are a spherical 5-design: the mean over them is the mean over the sphere for polynomials up to degree 5, so
    that mean and variance of a colour in harmonics up to degree 2 are exact.
    """
    golden = (1 + 5**0.5) / 2
    corners = [(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    turned = [corner[i:] + corner[:i] for i in range(3) for corner in corners]
    return torch.nn.functional.normalize(torch.tensor(turned), dim=-1)


def view_dependence(field: Field, view: "View") -> Tensor:
    """How much the colours of the visible splats vary with the direction from which they are seen.

    Each splat is seen from 12 places around it, as far away as the camera is, whatever is in between and whether or
    not the training had a photograph from there.

    Returns:
        Standard deviation of the colour over the directions, root mean square over the three channels, in units of
        white. [M, 1]
    """
    means = field.splats["means"].index_select(0, view.visible)
    distance = (view.center - means).norm(dim=-1, keepdim=True)
    around = [view._replace(center=means + distance * direction) for direction in icosahedron().to(means)]
    colors = torch.stack([field.seen_from(place).colors for place in around])
    return colors.var(dim=0, correction=0).mean(dim=-1, keepdim=True).sqrt()


def scaled_depth(depth: Tensor, accumulation: Tensor) -> Tensor:
    """Depths [H, W, 1] mapped to [0, 1]: the nearest to 0, FAR_QUANTILE of those that are mostly opaque to 1."""
    solid = depth[accumulation > 0.5]
    if solid.numel() == 0:
        return torch.zeros_like(depth)
    # Sorted by hand: torch.quantile refuses more than 16 million numbers.
    ranked = solid.sort().values
    near, far = ranked[0], ranked[int(FAR_QUANTILE * (len(ranked) - 1))]
    return ((depth - near) / (far - near).clamp_min(1e-10)).clamp(0.0, 1.0)


def _as_colors(component: Component) -> Tensor:
    """A change as a signed colour [M, 3]."""
    if component.kind == "color":
        return component.values
    return component.values * component.values.new_tensor(OPACITY_AXIS)


def _over_grey(view: "View", colors: Tensor, opacities: Tensor, accumulation: Tensor) -> Tensor:
    """Blend signed colours [M, 3] over grey, [H, W, 3] in [0, 1]."""
    render, _, _ = composite(view.projection, colors, opacities)
    return (render[0] + (1 - accumulation) * GREY).clamp(0.0, 1.0)


def _blend(view: "View", values: Tensor, opacities: Tensor, accumulation: Tensor) -> Tensor:
    """The mean of splats' numbers [M, 1] in each pixel, weighted as their colours are. [H, W, 1]"""
    # Three equal channels: gsplat's kernels have no short cut for one.
    render, _, _ = composite(view.projection, values.expand(-1, 3).contiguous(), opacities)
    return render[0][..., :1] / accumulation.clamp_min(1e-10)
