# SPDX-License-Identifier: Apache-2.0
"""An evaluation's table, and the appearance head's components in tensorboard, wandb or comet during training.

Between two training steps `track` renders the first test view. Numbers and pictures go through nerfstudio's writer,
histograms to tensorboard alone. No random number is drawn: a training is the same with and without.
"""

from collections.abc import Mapping
from statistics import median
from typing import Any

import torch
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from nrfgs_ns.image.metrics import lpips_advice
from nrfgs_ns.viewer.pictures import BASE, PictureOptions, picture

GROUP = "Appearance"
"""Prefix of all entries."""
SHOWN = ("psnr", "cc_psnr", "ssim", "cc_ssim", "ms_ssim", "lpips", "l1", "seconds_per_image", "splats")


def print_evaluation(result: Mapping[str, Any]) -> None:
    """Print the means over the test views, the worst view, and how to get LPIPS where it is missing."""
    names = [name for name in SHOWN if result.get(name) is not None]
    views = result["per_image"]
    title = "One test view: not a mean, and no measure of the whole"
    CONSOLE.print(title if len(views) == 1 else f"Means over {len(views)} test views", soft_wrap=True)
    table = Table()
    for name in names:
        table.add_column(name, justify="right")
    table.add_row(*(f"{result[name]:,}" if name == "splats" else f"{result[name]:.4g}" for name in names))
    CONSOLE.print(table)
    known = sorted((view["psnr"], view["image"]) for view in views if view.get("psnr") is not None)
    if len(known) > 1:
        (worst, name), middle = known[0], median(value for value, _ in known)
        worst = f"Median view {middle:.1f} dB. Worst {worst:.1f} dB: {name}. Pictures: --render-output-path FOLDER"
        CONSOLE.print(worst, markup=False, soft_wrap=True)
    if result.get("lpips") is None and (advice := lpips_advice()) is not None:
        CONSOLE.print(advice, markup=False, soft_wrap=True)


@torch.no_grad()
def track(pipeline: Pipeline, step: int, pictures: bool) -> None:
    """Log the head's components over the splats that the first test camera sees: the mean of weights and the root mean
    square of changes, in units of white or of opacity; with pictures, also images of the base colours and of each
    component."""
    pipeline.eval()
    model = pipeline.model
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(model.device)
    view = model.project(camera, model.field.splats)
    components = model.field.components_of(view)
    numbers = {"splats": model.num_points, "visible splats": len(view.visible)}
    for name, component in components.items():
        values = component.values.norm(dim=-1) if component.kind == "color" else component.values.squeeze(-1)
        count = max(len(values), 1)
        if component.kind == "weight":
            numbers[f"{name} (mean)"] = values.sum().item() / count
        else:
            numbers[f"{name} (rms)"] = (values.square().sum().item() / count) ** 0.5
        for listener in writer.EVENT_WRITERS:
            if isinstance(listener, writer.TensorboardWriter) and len(values) > 0:
                listener.tb_writer.add_histogram(f"{GROUP}/{name}", values, step)
    writer.put_dict(name=GROUP, scalar_dict=numbers, step=step)
    for mode in (BASE, *components) if pictures else ():
        writer.put_image(name=f"{GROUP}/{mode}", image=picture(model, camera, PictureOptions(mode))["rgb"], step=step)
    pipeline.train()
