# SPDX-License-Identifier: Apache-2.0
"""Fitted harmonics (`harmonics_fit.py`), trained for some steps to draw what the model draws.

The fit asks each splat alone. A splat whose opacity changes with the view has one opacity in a file, which is right for
few of them; its colour and its neighbours' can make up for much of that. So opacities and harmonics descend the squared
difference between the file's picture and the model's, one view a step. Means, rotations and scales stay, and no
photograph is asked for: each picture is taken from beside where a photograph was, because the model can be asked there,
and a file that only knows the photographs' places is worse between them.
"""

import math

import torch
from nerfstudio.cameras.cameras import Cameras
from torch.nn.functional import pad

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.model.harmonics_fit import DEGREE, PlainSplats, no_larger
from nrfgs_ns.model.renderer import View, composite_view
from nrfgs_ns.model.view_noise import camera_spacing
from nrfgs_ns.progress import progress

STEPS, STEPS_ON_A_CPU, STEPS_OF_A_VIEW = 2500, 400, 10
"""Steps, of one view each. A GPU takes seconds; a CPU makes STEPS_OF_A_VIEW for each view, at most STEPS_ON_A_CPU."""
RATES = {"opacities": 3.0, "features_dc": 0.15, "features_rest": 0.15}
"""Learning rates to begin with, where pictures are off by 1 (root of the mean square), and in proportion where they are
off by less: Adam's steps are no shorter there. They fall to 0 by half a cosine."""
MOVED = 0.5
"""How far from a photograph's place a picture is taken, in distances between such places; root of the mean square."""


def fine_tune(model, splats: PlainSplats, cameras: Cameras, steps: int | None = None) -> PlainSplats:
    """Splats as a file holds them whose pictures are nearer to a model's.

    Args:
        model: an NrfgsModel in evaluation mode.
        splats: one for each of the model's, with its means, rotations and scales. On its device.
        cameras: the training cameras, [V].
        steps: number of steps; None: as the device allows. 0 leaves the splats as they are.
    """
    if steps is None:
        steps = min(STEPS_ON_A_CPU, STEPS_OF_A_VIEW * len(cameras)) if model.device.type == "cpu" else STEPS
    if steps == 0:
        return splats
    tables = {name: getattr(splats, name).clone().requires_grad_() for name in RATES}
    field, file = model.field.detached(), Field(ShConfig(degree=DEGREE).setup(), {**splats._asdict(), **tables})
    background = model.background_color.to(model.device)
    generator = torch.Generator().manual_seed(0)

    def picture(of: Field, view: View) -> torch.Tensor:
        return composite_view(view, of.seen_from(view), background, with_depth=False)[0]["rgb"]

    def off_by(index: int, sigma: float) -> torch.Tensor:
        """The mean squared difference at a training view, or beside it."""
        camera = no_larger(cameras[index : index + 1].to(model.device))
        moved = sigma * torch.randn(3, 1, generator=generator)
        camera.camera_to_worlds = camera.camera_to_worlds + pad(moved, (3, 0)).to(model.device)
        with torch.no_grad():
            view = model.project(camera, file.splats)  # of both: nothing of the geometry is trained
            target = picture(field, view)
        return (picture(file, view) - target).square().mean()

    with torch.no_grad():
        off = torch.stack([off_by(index, 0.0) for index in range(len(cameras))]).mean().sqrt().item()
    groups = [{"params": [tables[name]], "lr": rate * off} for name, rate in RATES.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.5 * (1 + math.cos(math.pi * step / steps)))
    sigma = MOVED * camera_spacing(cameras.camera_to_worlds[:, :3, 3]) / math.sqrt(3.0)
    order: list[int] = []
    with progress("Fine-tuning the harmonics", steps) as advance:
        for _ in range(steps):
            order = order or torch.randperm(len(cameras), generator=generator).tolist()
            with torch.enable_grad():
                loss = off_by(order.pop(), sigma)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
            advance()
    return splats._replace(**{name: table.detach() for name, table in tables.items()})
