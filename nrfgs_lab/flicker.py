# SPDX-License-Identifier: Apache-2.0
"""Whether pictures hold still between test cameras, and at other sizes: python -m nrfgs_lab.flicker OUT.json CONFIG...

On paths from each test camera to the next, a frame's neighbours are warped into it by depth. `change` is the mean
difference from one, moving highlights included; `flicker` that from the mean of both, where steady change cancels out.
In 8-bit steps, over opaque pixels whose depths agree; another head's numbers tell what warping itself costs. `psnr`:
half size against a smaller photograph, full size, and double size made smaller.
"""

import json
from copy import deepcopy
from pathlib import Path
from statistics import fmean

import torch
import tyro
from nerfstudio.cameras.camera_utils import get_interpolated_poses
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from nrfgs_lab.training_run import machine
from nrfgs_ns.files import write_whole
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.trained.loading import load_model

OPAQUE, SAME_DEPTH = 0.95, 0.01
"""Least accumulation of a compared pixel; largest difference of two depths of a surface, as a share."""


@torch.no_grad()
def main(output: tyro.conf.Positional[Path], configs: tyro.conf.Positional[tuple[Path, ...]], frames: int = 30) -> None:
    """Write a record for each training; `frames`: from a test camera to the next."""
    records = []
    for config in configs:
        pipeline = load_model(config, "test")
        model, views = pipeline.model, pipeline.datamanager.fixed_indices_eval_dataloader
        record = {"config": str(config), "head": model.head.name, "splats": model.num_points, "frames": frames}
        record |= {**flicker(model, [camera for camera, _ in views], frames), "psnr": at_sizes(model, views)}
        records.append({**record, "machine": machine()})
        print(records[-1])
    write_whole(output, json.dumps(records, indent=1) + "\n")


def flicker(model, cameras: list, frames: int) -> dict[str, float]:
    """Means over pixels of all inner frames, NaN without any, and the share of the pixels that were compared."""
    sums = torch.zeros(4, dtype=torch.float64)
    for first, last in zip(cameras, cameras[1:], strict=False):
        ends = [one.camera_to_worlds.reshape(3, 4).cpu().double().numpy() for one in (first, last)]
        shown, camera = [], deepcopy(first)
        for pose in get_interpolated_poses(*ends, steps=frames):
            camera.camera_to_worlds = torch.tensor(pose).to(first.camera_to_worlds).view_as(first.camera_to_worlds)
            shown = [*shown[-2:], (model.pinhole(camera), model.get_outputs_for_camera(camera))]
            if len(shown) == 3:
                (before, same), (after, also) = (warped(*shown[1], *shown[i]) for i in (0, 2))
                now, seen = shown[1][1]["rgb"], same & also
                steps = torch.stack([after - now, now - (before + after) / 2])[:, seen].abs().mean(-1).sum(-1)
                sums += torch.tensor([*(255 * steps).tolist(), float(seen.sum()), seen.numel()])
    means = sums[:3] / sums[[2, 2, 3]]
    return {key: float(value) for key, value in zip(("change", "flicker", "compared"), means, strict=True)}


def warped(camera, frame, other, shown) -> tuple[torch.Tensor, torch.Tensor]:
    """What another camera shows of the surfaces in a frame, [H, W, 3], and whether it shows the same ones, [H, W]."""
    rays, turn = camera.rays(), other.viewmat[0, :3]
    points = camera.center + rays * frame["depth"] / (rays @ camera.viewmat[0, 2, :3])[..., None]
    x, y, z = (points @ turn[:, :3].T + turn[:, 3]).unbind(-1)
    pixels = (torch.stack([x / z, y / z, torch.ones_like(z)], dim=-1) @ other.K[0].T)[..., :2]
    place = pixels / pixels.new_tensor([other.width, other.height])
    channels = torch.cat([shown["rgb"], shown["depth"], shown["accumulation"]], dim=-1).permute(2, 0, 1)
    rgb, far, opaque = grid_sample(channels[None], 2 * place[None] - 1, align_corners=False)[0].split((3, 1, 1))
    same = ((far[0] - z).abs() < SAME_DEPTH * z) & (opaque[0] > OPAQUE) & (frame["accumulation"][..., 0] > OPAQUE)
    return rgb.permute(1, 2, 0), same


def at_sizes(model, views, sizes=(0.5, 1.0, 2.0)) -> dict[str, float]:
    """Mean PSNR over the test views, inside their masks, by size."""
    scores = {f"{size:g}": [] for size in sizes}
    for camera, batch in views:
        truth, mask = model.truth_of(batch, model._get_background_color()), model.mask_of(batch)
        for size in sizes:
            sized = deepcopy(camera)
            sized.rescale_output_resolution(size)
            images = model.get_outputs_for_camera(sized)["rgb"], truth, torch.ones_like(truth) if mask is None else mask
            shape = [min(images[0].shape[i], truth.shape[i]) for i in (0, 1)]
            images = [adaptive_avg_pool2d(x.float().permute(2, 0, 1), shape).permute(1, 2, 0) for x in images]
            scores[f"{size:g}"].append(psnr(*images[:2], images[2][..., :1] == 1.0))
    return {size: fmean(score for score in values if score is not None) for size, values in scores.items()}


if __name__ == "__main__":
    tyro.cli(main)
