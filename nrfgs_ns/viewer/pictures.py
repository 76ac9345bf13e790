# SPDX-License-Identifier: Apache-2.0
"""Pictures of an appearance head: one camera rendered in one of several modes. No viewer is needed.

Modes, besides those that the head itself offers (`AppearanceHead.components`):

    full              the image, with gain times the residual of colours and opacities: base + gain (trained - base)
    base colour       base colours with base opacities, as if the gain were 0
    view dependence   how much a splat's colour varies with the direction (`view_dependence`)
    depth             expected depth, dark near and bright far

Changes of colour or opacity are drawn around grey, AMPLIFICATION times as large; weights in viridis, dark to bright.
"""

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.colormaps import apply_float_colormap
from torch import Tensor

from nrfgs_ns.appearance.head import Field, SplatAppearance
from nrfgs_ns.rasterizer import View, composite

FULL, BASE, VIEW_DEPENDENCE, DEPTH = "full", "base colour", "view dependence", "depth"

GREY = 0.5
"""Where no change is drawn"""
AMPLIFICATION = 4.0
"""Factor of a change as drawn: a change of 1/8 of white uses up the whole range of colours."""
OPACITY_AXIS = (1.0, 0.0, -1.0)
"""Colour of a change of opacity: orange where the splat is more opaque than its base, blue where it is less."""
FULL_DEVIATION = 0.1
"""Standard deviation of colour that is drawn brightest"""
FAR_QUANTILE = 0.98
"""Share of the drawn pixels that set the range of depths: one floater must not flatten all else."""

LEGENDS = {
    "pixels": "The part without view dependence, or the image if there is none: this head colours pixels, not splats.",
    FULL: "The image as trained, with the residual times the gain.",
    BASE: "Base colours and base opacities: what does not depend on the view.",
    VIEW_DEPENDENCE: f"Deviation of a splat's colour over 12 directions: dark 0, bright {FULL_DEVIATION:g} or more.",
    DEPTH: "Expected depth: dark near, bright far.",
    "color": f"Grey: no change of colour. Otherwise the change times the gain, times {AMPLIFICATION:g}.",
    "opacity": f"Grey: no change. Orange: more opaque, blue: less; times the gain, times {AMPLIFICATION:g}.",
    "weight": "Dark 0, bright 1.",
}
"""Explanations by mode or kind of component"""


def legends(field: Field) -> dict[str, str]:
    """The line under the panel's dropdown, for each mode in which a field can be shown."""
    means = field.splats["means"]
    with torch.no_grad():
        components = field.head.components(field.splats, means.new_zeros(0, dtype=torch.int64), means.new_zeros(3))
    if field.head.at_pixel:
        return {FULL: LEGENDS[FULL], BASE: LEGENDS["pixels"], DEPTH: LEGENDS[DEPTH]}
    offered = {name: component.kind for name, component in components.items()}
    kinds = {FULL: FULL, BASE: BASE, **offered, VIEW_DEPENDENCE: VIEW_DEPENDENCE, DEPTH: DEPTH}
    return {mode: LEGENDS[kind] for mode, kind in kinds.items()}


@torch.no_grad()
def picture(
    model,
    camera: Cameras,
    mode: str = FULL,
    gain: float = 1.0,
    frozen_center: Tensor | None = None,
    photograph: int | None = None,
    background: Tensor | None = None,
) -> dict[str, Tensor]:
    """Render one camera, a batch of [1], in one mode.

    Args:
        model: an NrfgsModel in evaluation mode.
        mode: a key of `legends(model.field)`.
        gain: factor of the residuals, >= 0; 1 is as trained.
        frozen_center: point [3] from which splats are seen, in world units; None: the camera's.
        photograph: the training photograph whose exposure the image has; None: the mean of all.
        background: a colour [3] behind the splats instead of the configuration's.

    Returns:
        the model's `get_outputs`, with "rgb" [H, W, 3] in [0, 1] in this mode. Accumulation and depth belong to the
        image with its gain, or to the base for the base colour.
    """
    field = model.field
    view = model.project(camera, field.splats)
    if frozen_center is not None:
        view = view._replace(center=frozen_center.to(view.center))
    appearance = with_gain(field, view, 0.0 if mode == BASE else gain)
    outputs, _ = model.composite(view, appearance, background, model.look_of(photograph))
    if mode in (FULL, BASE):
        return outputs

    accumulation, behind = outputs["accumulation"], outputs["background"]
    if mode == DEPTH:
        share = scaled_depth(outputs["depth"], accumulation)
    elif mode == VIEW_DEPENDENCE:
        share = _blend(view, view_dependence(field, view) / FULL_DEVIATION, appearance.opacities, accumulation)
    else:
        component = field.head.components(field.splats, view.visible, view.center)[mode]
        if component.kind != "weight":
            axis = 1.0 if component.kind == "color" else component.values.new_tensor(OPACITY_AXIS)
            drawn = GREY + AMPLIFICATION * gain * component.values * axis
            render, _, _ = composite(view.projection, drawn, appearance.opacities)
            outputs["rgb"] = (render[0] + (1 - accumulation) * GREY).clamp(0.0, 1.0)
            return outputs
        share = _blend(view, component.values, appearance.opacities, accumulation)
    outputs["rgb"] = accumulation * apply_float_colormap(share.clamp(0.0, 1.0), "viridis") + (1 - accumulation) * behind
    return outputs


def with_gain(field: Field, view: View, gain: float) -> SplatAppearance:
    """The appearance of the visible splats with `gain` times their residual: at 1 the head's own, to the bit; at 0 the
    base appearance."""
    if gain == 1.0:
        return field.seen_from(view)
    base, trained = field.base_of(view), field.seen_from(view)
    colors = base.colors + gain * (trained.colors - base.colors)
    return SplatAppearance(
        colors=colors if field.head.at_pixel else colors.clamp_min(0.0),
        opacities=(base.opacities + gain * (trained.opacities - base.opacities)).clamp(0.0, 1.0),
    )


def icosahedron() -> Tensor:
    """Unit vectors to the 12 corners of an icosahedron, [12, 3]: a spherical 5-design, whose mean and variance of
    harmonics up to degree 2 are exact."""
    golden = (1 + 5**0.5) / 2
    corners = [(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    turned = [corner[i:] + corner[:i] for i in range(3) for corner in corners]
    return torch.nn.functional.normalize(torch.tensor(turned), dim=-1)


def view_dependence(field: Field, view: View) -> Tensor:
    """Standard deviation of the visible splats' colours over 12 directions at the camera's distance: root mean square
    over the channels, in units of white. [M, 1]"""
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
    ranked = solid.sort().values  # torch.quantile refuses more than 16 million numbers
    near, far = ranked[0], ranked[int(FAR_QUANTILE * (len(ranked) - 1))]
    return ((depth - near) / (far - near).clamp_min(1e-10)).clamp(0.0, 1.0)


def _blend(view: View, values: Tensor, opacities: Tensor, accumulation: Tensor) -> Tensor:
    """The mean of splats' numbers [M, 1] in each pixel, weighted as their colours are. [H, W, 1]"""
    # Three equal channels: gsplat's kernels have no short cut for one.
    render, _, _ = composite(view.projection, values.expand(-1, 3).contiguous(), opacities)
    return render[0][..., :1] / accumulation.clamp_min(1e-10)
