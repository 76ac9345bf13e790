# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning of fitted harmonics (`harmonics_fit.py`), so that a file's pictures are closer to the model's.

The fit treats each splat alone, and gives it one opacity even if the model's changes with the view; its colour and its
neighbours' can make up for much of that. So opacities and harmonics descend the squared difference between the file's
picture and the model's, one view a step. Means, rotations and scales stay, and no photographs are needed: pictures are
taken beside the training cameras, since a file tuned at these alone is worse between them.
"""

import math

import torch
from nerfstudio.cameras.cameras import Cameras
from torch.nn.functional import pad

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.data.views import camera_spacing
from nrfgs_ns.model.harmonics_fit import DEGREE, PlainSplats, no_larger
from nrfgs_ns.progress import progress
from nrfgs_ns.rasterizer import View, composite_view

STEPS, STEPS_ON_A_CPU, STEPS_OF_A_VIEW = 2500, 400, 10
"""Steps, of one view each. A GPU takes seconds; a CPU makes STEPS_OF_A_VIEW for each view, at most STEPS_ON_A_CPU."""
RATES = {"opacities": 3.0, "features_dc": 0.15, "features_rest": 0.15}
"""Initial learning rates, times the root mean square difference of the pictures: Adam's steps do not shrink with it.
They fall to 0 by half a cosine."""
OFFSET = 0.5
"""Root mean square distance of a picture from a training camera, in the cameras' spacing."""


def fine_tune(model, splats: PlainSplats, cameras: Cameras, steps: int | None = None) -> PlainSplats:
    """Change splats so that their pictures are closer to a model's.

    Args:
        model: an NrfgsModel in evaluation mode.
        splats: the fit of the model's own, on its device.
        cameras: the training cameras, [V].
        steps: number of steps; None: as the device allows. 0 leaves the splats as they are.
    """
    if steps is None:
        steps = min(STEPS_ON_A_CPU, STEPS_OF_A_VIEW * len(cameras)) if model.device.type == "cpu" else STEPS
    if steps == 0:
        return splats
    tables = {name: getattr(splats, name).clone().requires_grad_() for name in RATES}
    field = model.field.detached()
    file = Field(ShConfig(degree=DEGREE).setup(), {**splats._asdict(), **tables})
    background = model.background_color.to(model.device)
    generator = torch.Generator().manual_seed(0)

    def picture(of: Field, view: View) -> torch.Tensor:
        return composite_view(view, of.seen_from(view), background, with_depth=False)[0]["rgb"]

    def squared_difference(index: int, sigma: float) -> torch.Tensor:
        """Mean squared difference of the pictures from a random place, `sigma` off a training camera in each axis."""
        camera = no_larger(cameras[index : index + 1].to(model.device))
        offset = sigma * torch.randn(3, 1, generator=generator)
        camera.camera_to_worlds = camera.camera_to_worlds + pad(offset, (3, 0)).to(model.device)
        with torch.no_grad():
            view = model.project(camera, file.splats)  # the same for both: geometry is not trained
            target = picture(field, view)
        return (picture(file, view) - target).square().mean()

    with torch.no_grad():
        rms = torch.stack([squared_difference(index, 0.0) for index in range(len(cameras))]).mean().sqrt().item()
    groups = [{"params": [tables[name]], "lr": rate * rms} for name, rate in RATES.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.5 * (1 + math.cos(math.pi * step / steps)))
    sigma = OFFSET * camera_spacing(cameras.camera_to_worlds[:, :3, 3]) / math.sqrt(3.0)
    order: list[int] = []
    with progress("Fine-tuning the harmonics", steps) as advance:
        for _ in range(steps):
            order = order or torch.randperm(len(cameras), generator=generator).tolist()
            with torch.enable_grad():
                loss = squared_difference(order.pop(), sigma)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
            advance()
    return splats._replace(**{name: table.detach() for name, table in tables.items()})
