# SPDX-License-Identifier: Apache-2.0
"""A training of few views starts with points from its photographs, beside the capture's own (docs/captures.md)."""

from functools import partial
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track

from nrfgs_ns.data.plane_sweep import dense_points, share_kept, small_views
from nrfgs_ns.model.renderer import world_to_camera


def start_with_dense_points(model: Any, datamanager: Any) -> list[str]:
    """Let a model that has not been trained start with more points.

    Args:
        model: an NrfgsModel.
        datamanager: with its images read.

    Returns:
        How many points, in words; nothing where there are no others than the capture's.
    """
    config, own = model.config, model.seed_points
    share = share_kept(model.num_views) if config.dense_start == "auto" and not config.random_init else 0.0
    if share == 0 or own is None:
        return []
    cameras, images = datamanager.train_dataset.cameras.to(model.device), datamanager.cached_train
    poses = world_to_camera(cameras.camera_to_worlds)
    intrinsics = cameras.get_intrinsics_matrices().to(poses)  # nerfstudio makes them on the CPU
    masks = [batch.get("mask") for batch in images]
    views = small_views((batch["image"] for batch in images), masks, intrinsics, poses)
    progress = partial(track, description="Points from photographs", console=CONSOLE, transient=True)
    xyz, rgb = dense_points(views, own[0].to(poses), share, progress)
    model.start_from((torch.cat([own[0], xyz.to(own[0])]), torch.cat([own[1], (255 * rgb).to(own[1])])))
    return [f"start: {len(own[0]):,} points of the capture, {len(xyz):,} from the photographs"]
