# SPDX-License-Identifier: Apache-2.0
"""The splats that a training starts from, as in splatfacto. A training of few views also starts with points from its
photographs (docs/captures.md)."""

from functools import partial
from typing import Any

import torch
from nerfstudio.models.splatfacto import random_quat_tensor
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from scipy.spatial import cKDTree
from torch import Tensor

from nrfgs_ns.appearance.head import AppearanceHead
from nrfgs_ns.data.plane_sweep import dense_points, share_kept, small_views
from nrfgs_ns.model.config import NrfgsModelConfig
from nrfgs_ns.rasterizer import world_to_camera

OPACITY = 0.1
"""Initial opacity of every splat."""
LONE_STD = 0.01
"""Standard deviation of a single splat, in scene units."""
SMALLEST_STD = 1e-7
"""Smallest standard deviation, in scene units, for points that coincide."""


def initial_splats(
    config: NrfgsModelConfig, head: AppearanceHead, seed_points: tuple[Tensor, Tensor] | None, scene_unit: float
) -> dict[str, Tensor]:
    """The initial table: a round splat at each seed point, as wide as the mean distance of its neighbours.

    Args:
        head: adds its own tensors.
        seed_points: positions [N, 3] in world units and colours [N, 3] in 0..255; None: random ones.
        scene_unit: world units in a scene unit.
    """
    if seed_points is not None and not config.random_init:
        means, rgb = seed_points[0].float().clone(), seed_points[1].float() / 255.0
    else:
        means = (torch.rand(config.num_random, 3) - 0.5) * config.random_scale * scene_unit
        rgb = torch.rand(len(means), 3)
    count = len(means)
    width = mean_distance(means) if count > 1 else torch.full((count, 1), LONE_STD * scene_unit)
    return {
        "means": means,
        "scales": width.clamp_min(SMALLEST_STD * scene_unit).log().repeat(1, 3),
        "quats": random_quat_tensor(count),
        "opacities": torch.logit(torch.full((count, 1), OPACITY)),
        **head.splat_params(rgb),
    }


def mean_distance(means: Tensor) -> Tensor:
    """Mean distance of each point [N, 3] to the three nearest others, [N, 1]."""
    # Equal to scikit-learn's distances in splatfacto to the last bit, without its second of import.
    points = means.cpu().numpy()
    distances, _ = cKDTree(points).query(points, k=min(4, len(points)), workers=-1)
    return torch.from_numpy(distances[:, 1:]).float().mean(dim=-1, keepdim=True)


def start_with_dense_points(model: Any, datamanager: Any) -> None:
    """Add points from the photographs to a model that has not been trained, if `dense_start` says so.

    Args:
        model: an NrfgsModel.
        datamanager: its datamanager, with all images read.
    """
    if model.config.dense_start != "auto" or model.config.random_init or model.seed_points is None:
        return
    if (share := share_kept(model.num_views)) == 0:
        return
    positions, colors = model.seed_points
    cameras = datamanager.train_dataset.cameras.to(model.device)
    images = datamanager.cached_train
    poses = world_to_camera(cameras.camera_to_worlds)
    intrinsics = cameras.get_intrinsics_matrices().to(poses)  # nerfstudio makes them on the CPU
    masks = [batch.get("mask") for batch in images]
    views = small_views((batch["image"] for batch in images), masks, intrinsics, poses)
    progress = partial(track, description="Points from photographs", console=CONSOLE, transient=True)
    xyz, rgb = dense_points(views, positions.to(poses), share, progress)
    model.depth_maps = dense_points.maps
    model.start_from((torch.cat([positions, xyz.to(positions)]), torch.cat([colors, (255 * rgb).to(colors)])))
