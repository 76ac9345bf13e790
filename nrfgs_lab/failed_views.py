# SPDX-License-Identifier: Apache-2.0
"""Why test views fail: their PSNR with suspect splats left out (docs/captures.md).

    python -m nrfgs_lab.failed_views outputs/.../config.yml

A training with `--pipeline.model.near-plane off` shows what floats before its cameras.
"""

from pathlib import Path

import torch
import tyro
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table
from torch import Tensor

from nrfgs_ns.data.views import nearest_depth
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.rasterizer import contributions, world_to_camera
from nrfgs_ns.trained.loading import load_model

LEAST_SHOWN = 1.0
"""Contribution from which a view shows a splat, in pixels."""
NEAR = 0.3, 0.5, 0.8
"""A splat is near if its depth is below this share of the depth of the nearest points in the view."""
BESIDE = 2.0
"""Splats beside the cameras were shown closer than this, in nearest depths, and mostly with the mean off the image."""


def seen_in_training(pipeline) -> Tensor:
    """Of each splat: training views that show it, images with its mean, their share of it, its least depth, [4, N]."""
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
    seen = torch.zeros(4, model.num_points, device=model.device)
    least = torch.full_like(seen[0], torch.inf)
    for index in range(len(cameras)):
        view = model.project(cameras[index : index + 1].to(model.device))
        share = contributions(view.projection, model.field.seen_from(view).opacities)
        x, y = view.projection.means2d.unbind(-1)
        within = (x > 0) & (x < view.projection.width) & (y > 0) & (y < view.projection.height)
        seen[:, view.visible] += torch.stack([share > LEAST_SHOWN, within, share * within, share])
        depths = view.projection.depths.where(share > LEAST_SHOWN, torch.inf)
        least[view.visible] = least[view.visible].minimum(depths)
    return torch.stack([*seen[:2], seen[2] / seen[3], least])


@torch.no_grad()
def failed_views(pipeline) -> dict[str, dict[str, float]]:
    """PSNR of each test view without each kind of suspects, in dB: image name -> what is left out -> PSNR."""
    model, data = pipeline.model, pipeline.datamanager
    shown, inside, framed, least = seen_in_training(pipeline)
    points = (model.seed_points or [model.means[:0]])[0].to(model.device)
    result = {}
    close = least < BESIDE * nearest_depth(points, data.train_dataset.cameras.to(model.device))
    suspects = {"shown by 1": shown <= 1, "in 1 image": inside <= 1, "beside": close & (framed < 0.5)}
    pairs = zip(data.eval_dataset.image_filenames, data.fixed_indices_eval_dataloader, strict=True)
    for name, (camera, batch) in pairs:
        camera = camera.to(model.device)
        pose = world_to_camera(camera.camera_to_worlds)[0]
        depths = model.means @ pose[2, :3] + pose[2, 3]
        nearest = nearest_depth(points, camera)
        near = {f"nearer than {share}": depths < share * nearest for share in NEAR}
        row = result[Path(name).name] = {}
        for left_out, chosen in {"nothing": torch.zeros_like(close), **near, **suspects}.items():
            field = model.field._replace(splats={key: value[~chosen] for key, value in model.field.splats.items()})
            outputs = model.render(field, camera, field)
            row[left_out] = psnr(outputs["rgb"], model.truth_of(batch, outputs["background"]), model.mask_of(batch))
    return result


def main(config: tyro.conf.Positional[Path]) -> None:
    """Print the PSNR of each test view with suspects left out, from a training's config.yml."""
    views = failed_views(load_model(config, "test"))
    table = Table("view", *next(iter(views.values())), title="PSNR without splats that are ...")
    for name, row in views.items():
        table.add_row(name, *("-" if value is None else f"{value:.2f}" for value in row.values()))
    CONSOLE.print(table)


if __name__ == "__main__":
    tyro.cli(main)
