# SPDX-License-Identifier: Apache-2.0
"""FLIP of a training's test views (Andersson et al., PACMCGIT 3(2), 2020): how different two pictures look, in [0, 1],
lower is better. The package `flip-evaluator` computes it (`pip install flip-evaluator`), at its 67 pixels a degree.

    python -m nrfgs_lab.flip CONFIG.yml [OUT.json]
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

from nrfgs_ns.errors import InputError


def flip(pred: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Mean FLIP.

    Args:
        pred, truth: sRGB images [H, W, 3] in [0, 1].
        mask: bool [H, W], True inside: outside, the prediction is replaced by the truth, and left out of the mean.

    Returns:
        In [0, 1]; None if nothing is inside.

    Raises:
        InputError: `flip-evaluator` is missing.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise InputError("FLIP needs the package flip-evaluator: pip install flip-evaluator") from error
    if mask is not None:
        if not mask.any():
            return None
        pred = np.where(mask[..., None], pred, truth)
    images = (np.ascontiguousarray(image, dtype=np.float32) for image in (truth, pred))
    errors = np.squeeze(flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0], axis=-1)
    return float(errors.mean() if mask is None else errors[mask].mean())


@torch.no_grad()
def flip_of(config: Path) -> dict[str, float | None]:
    """FLIP of each test view of a training, by the image's name."""
    from nerfstudio.utils.eval_utils import eval_setup

    _, pipeline, _, _ = eval_setup(config)
    model, data = pipeline.model.eval(), pipeline.datamanager
    found = {}
    for name, (camera, batch) in zip(
        data.eval_dataset.image_filenames, data.fixed_indices_eval_dataloader, strict=True
    ):
        outputs = model.get_outputs_for_camera(camera)
        truth = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
        mask = batch["mask"][..., 0].numpy(force=True) >= 0.5 if "mask" in batch else None
        found[Path(name).name] = flip(outputs["rgb"].numpy(force=True), truth.numpy(force=True), mask)
    return found


if __name__ == "__main__":
    per_view = flip_of(Path(sys.argv[1]))
    known = [value for value in per_view.values() if value is not None]
    for name, value in per_view.items():
        print(f"{name}: {'-' if value is None else format(value, '.4f')}")
    print(f"mean: {sum(known) / len(known):.4f}" if known else "nothing is inside the masks")
    if len(sys.argv) > 2:
        Path(sys.argv[2]).write_text(json.dumps(per_view, indent=1) + "\n", encoding="utf-8")
