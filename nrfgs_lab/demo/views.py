# SPDX-License-Identifier: Apache-2.0
"""A trained model beside the truth of a procedural scene: test views, views along an arc, scores."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nrfgs_lab.scenes import SceneConfig, build_scene, camera_rays, dome_cameras, render
from nrfgs_lab.scenes.dataset import split_names
from nrfgs_ns.image.metrics import psnr

SHINES = 0.1
"""Change of white by gloss, in its strongest channel, from which a pixel of the truth counts as one that shines."""
ARC = 24.0  # Angle over which the camera moves around a highlight, degrees.
FRAMES = 7  # Views along that arc.


@dataclass
class SeenView:
    """One view of the scene, as a trained model shows it. Pictures are [H, W, 3] in [0, 1]."""

    truth: Tensor
    dull: Tensor  # the truth without gloss, as the ray tracer has it
    rendered: Tensor
    base: Tensor  # base colours and opacities alone

    @property
    def shine(self) -> Tensor:
        """What gloss does to a pixel, its strongest channel, [H, W]."""
        return (self.truth - self.dull).abs().amax(dim=-1)


@dataclass
class Highlight:
    """The same place on a surface while the camera moves around it. Pictures are [H, W, 3] in [0, 1]."""

    window: tuple[int, int, int, int]  # top, left, height and width of the place in each picture, pixels
    truths: list[Tensor]
    rendered: list[Tensor]


class Look:
    """A finished training on a procedural scene."""

    def __init__(self, config: Path, scene: SceneConfig):
        from nrfgs_ns.trained.loading import load_model

        self.pipeline = load_model(config, "test")
        self.scene, self.glossy, self.dull = scene, build_scene(scene), build_scene(replace(scene, gloss=0.0))
        self.views = list(self.pipeline.datamanager.fixed_indices_eval_dataloader)
        """nerfstudio's camera and batch of each test view"""
        poses = dict(zip(sorted(sum(split_names(scene), [])), dome_cameras(scene), strict=True))
        names = self.pipeline.datamanager.eval_dataset.image_filenames
        self.poses = [poses[f"images/{Path(name).name}"] for name in names]
        """camera-to-world matrices [4, 4] of the test views, in the scene's world"""

    def test_views(self) -> list[SeenView]:
        """All test views."""
        model, views = self.pipeline.model, []
        for pose, (camera, batch) in zip(self.poses, self.views, strict=True):
            truth = model.get_gt_img(batch["image"])[..., :3].cpu()
            rendered, base = model.get_outputs_for_camera(camera)["rgb"], model.get_base_color(camera)
            views.append(SeenView(truth, torch.from_numpy(render(self.dull, pose)), rendered.cpu(), base.cpu()))
        return views

    def highlight(self, view: int, shine: Tensor) -> Highlight:
        """The place of a test view where gloss does most (`shine`, [H, W]), from an arc of views about its vertical."""
        window = brightest_window(shine)
        middle = np.array([[window[1] + 0.5 * window[3], window[0] + 0.5 * window[2]]])
        points, _ = self.glossy.first_hit(*camera_rays(self.scene, self.poses[view], middle))
        camera, _ = self.views[view]
        outputs = self.pipeline.datamanager.train_dataparser_outputs
        to_model = outputs.dataparser_transform.double().numpy()
        truths, rendered = [], []
        for angle in np.radians(np.linspace(-0.5 * ARC, 0.5 * ARC, FRAMES)):
            pose = turned(self.poses[view], points[0], float(angle))
            moved = to_model @ pose
            moved[:, 3] *= outputs.dataparser_scale
            camera.camera_to_worlds = torch.from_numpy(moved)[None].to(camera.camera_to_worlds)
            truths.append(torch.from_numpy(render(self.glossy, pose)))
            rendered.append(self.pipeline.model.get_outputs_for_camera(camera)["rgb"].cpu())
        return Highlight(window, truths, rendered)


def turned(pose: np.ndarray, point: np.ndarray, angle: float) -> np.ndarray:
    """A pose [4, 4] turned by `angle` radians about the vertical through a point [3], seen at the same pixel."""
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    turn[:3, 3] = point - turn[:3, :3] @ point
    return turn @ pose


def brightest_window(shine: Tensor) -> tuple[int, int, int, int]:
    """The window of a third of a picture's sides in which gloss does most: top, left, height, width, pixels."""
    height, width = (max(size // 3, 1) for size in shine.shape)
    sums = torch.nn.functional.avg_pool2d(shine[None, None], (height, width), stride=1)[0, 0]
    place = int(sums.argmax())
    return place // sums.shape[1], place % sums.shape[1], height, width


def where_it_shines(views: list[SeenView]) -> dict[str, Any]:
    """PSNR of the pixels whose truth gloss changes by more than SHINES, None where there are none.

    Returns:
        "psnr" over all views and "views" of each, the same of the base colour alone ("psnr_base", "views_base"), and
        "share" of such pixels.
    """
    truths = torch.stack([view.truth for view in views])
    inside = torch.stack([view.shine > SHINES for view in views])[..., None]
    result: dict[str, Any] = {"share": float(inside.float().mean())}
    for kind, name in (("", "rendered"), ("_base", "base")):
        images = torch.stack([getattr(view, name) for view in views])
        result[f"psnr{kind}"] = psnr(images.flatten(0, 1), truths.flatten(0, 1), inside.flatten(0, 1))
        result[f"views{kind}"] = [*map(psnr, images, truths, inside)]
    return result
