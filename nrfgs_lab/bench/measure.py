# SPDX-License-Identifier: Apache-2.0
"""Measurements of a trained model, the same for every method: test views, training views, time and bytes.

`ns-eval` depends on the method: splatfacto's has neither L1 nor MS-SSIM, ignores masks, and does not wait for the GPU
when it times frames.
"""

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.eval_utils import eval_setup

from nrfgs_lab.training_run import synchronize
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.image.metrics import METRIC_NAMES, image_metrics

TIMED_CAMERAS = 20  # Test cameras, evenly spaced, for frames per second.
TIMED_SECONDS = 1.0  # Shortest time of rendering them in turn.
FULL_HD = 1920, 1080  # Second size for frames per second.


@torch.no_grad()
def measure(config_path: Path, train_views: int, timed: bool = True) -> dict[str, Any]:
    """Load the last checkpoint of a training and measure it at full resolution; frame rates (`timed`) need an idle GPU.

    Returns:
        "test" and "train" (null without views), each with "per_image" and means of psnr, ssim, ms_ssim, l1, lpips (null
        without weights), flip (null without `flip-evaluator`), colour-corrected cc_psnr, ...; "fps" at the photographs'
        size and "fps_1080p" (null on a CPU), null if not timed; "splats"; "parameter_bytes" of a renderer;
        "checkpoint_bytes" with the optimisers' moments.
    """
    _, pipeline, checkpoint, _ = eval_setup(Path(config_path))
    model, data = pipeline.model, pipeline.datamanager
    model.eval()
    test = data.fixed_indices_eval_dataloader
    names = [Path(name).name for name in data.eval_dataset.image_filenames]
    result: dict[str, Any] = {"test": over_views(model, zip(names, test, strict=True)), "train": None}
    if train_views > 0:
        images = data.cached_train  # before the cameras: undistortion crops them while it loads the images
        cameras = data.train_dataset.cameras
        chosen = evenly_spaced(len(images), train_views)
        views = ((cameras[i : i + 1].to(model.device), images[i]) for i in chosen)
        names = [Path(data.train_dataset.image_filenames[i]).name for i in chosen]
        result["train"] = over_views(model, zip(names, views, strict=True))
    cameras = [camera for camera, _ in test]
    large = [at_size(camera, *FULL_HD) for camera in cameras]
    return {
        **result,
        "fps": frames_per_second(model, cameras) if timed else None,
        "fps_1080p": frames_per_second(model, large) if timed and model.device.type == "cuda" else None,
        "splats": int(model.num_points),
        "parameter_bytes": getattr(model, "parameter_bytes", None)  # nerfstudio's own have splats and no more
        or sum(parameter.numel() * parameter.element_size() for parameter in model.gauss_params.values()),
        "checkpoint_bytes": Path(checkpoint).stat().st_size,
    }


def over_views(model, views: Iterable) -> dict[str, Any]:
    """Means and each image's values over (name, (camera, batch))."""
    per_image = []
    for name, (camera, batch) in views:
        outputs = model.get_outputs_for_camera(camera)
        truth = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
        mask = batch["mask"].to(model.device).float() >= 0.5 if "mask" in batch else None
        per_image.append({"image": name, **image_metrics(outputs["rgb"], truth, mask)})
        if find_spec("flip_evaluator") is not None:
            arrays = [None if image is None else image.numpy(force=True) for image in (outputs["rgb"], truth, mask)]
            per_image[-1]["flip"] = flip(*arrays)
    means = {}
    for metric in (*METRIC_NAMES, "flip"):
        values = [image[metric] for image in per_image if image.get(metric) is not None]
        means[metric] = sum(values) / len(values) if values else None
    return {**means, "per_image": per_image}


def flip(pred: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Mean FLIP (Andersson et al., PACMCGIT 3(2), 2020) of sRGB images [H, W, 3] in [0, 1] at 67 pixels a degree; lower
    is better. Outside the mask, bool [H, W, 1], the images count as equal and no pixel enters the mean; None if it is
    empty."""
    import flip_evaluator

    inside = np.ones_like(truth[..., :1], dtype=bool) if mask is None else mask
    images = (np.ascontiguousarray(image, dtype=np.float32) for image in (truth, np.where(inside, pred, truth)))
    errors = flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0]
    return float(errors.reshape(inside.shape)[inside].mean()) if inside.any() else None


def at_size(camera: Cameras, width: int, height: int) -> Cameras:
    """Camera [1] with another image size and the same vertical angle."""
    scale = height / camera.height
    size = {"width": torch.full_like(camera.width, width), "height": torch.full_like(camera.height, height)}
    return Cameras(camera.camera_to_worlds, camera.fx * scale, camera.fy * scale, width / 2, height / 2, **size).to(
        camera.device
    )


def frames_per_second(model, cameras: list) -> float:
    """Renderings per second of wall-clock, after an untimed one of each."""
    chosen = [cameras[i].to(model.device) for i in evenly_spaced(len(cameras), TIMED_CAMERAS)]

    def seconds_of_all() -> float:
        start = perf_counter()
        for camera in chosen:
            model.get_outputs_for_camera(camera)
        synchronize()
        return perf_counter() - start

    seconds_of_all()
    rounds = [seconds_of_all()]
    while sum(rounds) < TIMED_SECONDS:
        rounds.append(seconds_of_all())
    return len(rounds) * len(chosen) / sum(rounds)
