# SPDX-License-Identifier: Apache-2.0
"""What a written file has lost against the model that it was written from."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from nrfgs_ns.errors import InputError


@torch.no_grad()
def measure_loss(pipeline, pictures: Callable[[Any], dict[str, Tensor]]) -> dict[str, Any]:
    """Compare pictures with the photographs, on the test views.

    Args:
        pipeline: of the model, with its test images.
        pictures: renders a camera, a batch of one: name -> image [H, W, 3]. One of them is "file".

    Returns:
        Means over the images, dB, inside their masks: psnr_model, and psnr_NAME of each picture. loss_db: what the file
        lacks of the model. per_image: each image's values.

    Raises:
        InputError: no test image has pixels inside its mask.
    """
    from nerfstudio.utils.rich_utils import CONSOLE

    from nrfgs_ns.image.metrics import psnr

    model = pipeline.model
    names = [Path(name).name for name in pipeline.datamanager.eval_dataset.image_filenames]
    images = list(zip(names, pipeline.datamanager.fixed_indices_eval_dataloader, strict=True))
    per_image, scores = [], {}
    columns = TextColumn("Measuring the loss"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=CONSOLE, transient=True) as progress:
        for image, (camera, batch) in progress.track(images):
            outputs = model.get_outputs_for_camera(camera)
            truth, mask = model.truth_of(batch, outputs["background"]), model.mask_of(batch)
            every = {"model": outputs["rgb"], **pictures(camera)}
            scores = {f"psnr_{name}": psnr(picture, truth, mask) for name, picture in every.items()}
            if None not in scores.values():  # nothing inside the mask
                per_image.append({"image": image, **scores})
    if not per_image:
        raise InputError("The file is written, but no test image has pixels inside its mask. Use --no-measure.")
    means = {key: sum(one[key] for one in per_image) / len(per_image) for key in scores}
    return {**means, "loss_db": means["psnr_model"] - means["psnr_file"], "per_image": per_image}
