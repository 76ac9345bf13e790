# SPDX-License-Identifier: Apache-2.0
"""The training loss, shared by the eager step, the recorded step (`training/step_graph.py`) and each of several devices
(`distributed/model.py`)."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from nrfgs_ns.image.ssim import photometric_loss

HALVING_VIEWS = 12
"""Training views that halve the model's `shrinkage`."""
NEGLIGIBLE = 1e-6
"""Smaller weights of shrinkage count as zero: Adam turns any into whole steps of splats that no view sees."""


def loss_of(
    model, splats: Mapping[str, Tensor], outputs: Mapping[str, Any], batch: Mapping[str, Any], is_between: bool = False
) -> dict[str, Tensor]:
    """The terms of one rendered camera's loss, scalars by name; a step descends their sum.

    Terms that are zero in this step are left out. Nothing waits for the GPU.

    Args:
        model: an NrfgsModel. In evaluation there is only the photometric term.
        splats: the rendered table, whose tensors get gradients.
        outputs: "rgb" [H, W, 3] in [0, 1] and "background" [H, W, 3], as rendered.
        batch: the datamanager's "image", and "mask" if there is one.
        is_between: the image is a twin's picture (`training/twin.py`), whose loss has only the photometric term, too.
    """
    losses = {"main_loss": photometric(model, outputs, batch, is_between)}
    if model.training and not is_between:
        model.camera_optimizer.get_loss_dict(losses)
        losses |= model.densification.regularisation(splats) | shrinkage(model, splats)
    return losses


def photometric(model, outputs: Mapping[str, Any], batch: Mapping[str, Any], is_between: bool = False) -> Tensor:
    """Splatfacto's loss of an image against its photograph, (1 - lambda) L1 + lambda (1 - SSIM), a scalar. Of
    photographs alone pixels are trimmed, and residuals remembered."""
    rgb = outputs["rgb"]
    truth = model.truth_of(batch, outputs["background"])
    mask = None
    if "mask" in batch:  # pixels outside are black in both
        mask = model._downscale_if_required(batch["mask"]).to(model.device)
        truth, rgb = truth * mask, rgb * mask
    if model.trimming is not None and model.training and not is_between and model.trimming.is_on(model.schedule_step):
        kept = model.trimming(rgb, truth, model.schedule_step, mask)
        truth, rgb = truth * kept, rgb * kept
    return photometric_loss(rgb, truth, model.config.ssim_lambda)


def shrinkage(model, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Terms for the splats' mean opacity, and mean size in scene units, unless their weight is zero or the strategy has
    its own."""
    own, added = model.config.shrinkage, model.config.densification
    weight = (own * 0.5 ** (model.num_views / HALVING_VIEWS) + added.shrinkage) / 100
    if weight < NEGLIGIBLE or added.regularises:
        return {}
    return {
        "shrink_opacities": weight * model.densification.mean_opacity(splats["opacities"]),
        "shrink_scales": weight / model.scene_unit * splats["scales"].exp().mean(),
    }
