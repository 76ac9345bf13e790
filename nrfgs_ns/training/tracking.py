# SPDX-License-Identifier: Apache-2.0
"""What tensorboard (or Weights & Biases, or Comet) is told about the appearance head while it trains.

Between two training steps the first test view is looked at: always the same one, so that the curves and pictures of a
training can be compared. Numbers and histograms are written every `steps_per_eval_image` steps, pictures every
`steps_per_eval_all_images`. Numbers and pictures go through nerfstudio's writer to whatever listens, histograms to
tensorboard alone, the one writer that has them. Without such a writer nothing is computed. No random number is drawn,
so a training is the same with and without.
"""

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils import writer
from torch import Tensor

from nrfgs_ns.appearance.head import Component
from nrfgs_ns.model.model import NrfgsModel
from nrfgs_ns.viewer.pictures import BASE, Shown, picture

GROUP = "Appearance"
"""What the names of all entries begin with."""


def magnitudes(component: Component) -> Tensor:
    """One number for each splat, [M]: a colour's change by its length, anything else as it is."""
    return component.values.norm(dim=-1) if component.kind == "color" else component.values.squeeze(-1)


def summary(components: dict[str, Component]) -> dict[str, float]:
    """Changes by their root mean square over the splats, in units of white or of opacity; weights by their mean.

    A camera that sees no splat gives 0.
    """
    numbers = {}
    for name, component in components.items():
        values = magnitudes(component)
        if component.kind == "weight":
            numbers[f"{name} (mean)"] = values.sum().item() / max(len(values), 1)
        else:
            numbers[f"{name} (rms)"] = (values.square().sum().item() / max(len(values), 1)) ** 0.5
    return numbers


@torch.no_grad()
def track(model: NrfgsModel, camera: Cameras, step: int, pictures: bool) -> None:
    """Log what the head of a model in evaluation mode does to the splats that one camera sees; with pictures, its base
    colours and each component, too.
    """
    field = model.field
    view = model.project(camera, field.splats)
    components = field.components_of(view)
    numbers = {"splats": model.num_points, "visible splats": len(view.visible), **summary(components)}
    writer.put_dict(name=GROUP, scalar_dict=numbers, step=step)
    for mode in (BASE, *components) if pictures else ():
        writer.put_image(name=f"{GROUP}/{mode}", image=picture(model, camera, Shown(mode))["rgb"], step=step)
    for listener in writer.EVENT_WRITERS:
        if isinstance(listener, writer.TensorboardWriter) and len(view.visible) > 0:
            for name, component in components.items():
                listener.tb_writer.add_histogram(f"{GROUP}/{name}", magnitudes(component), step)
