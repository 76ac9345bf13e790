# SPDX-License-Identifier: Apache-2.0
"""Training views as densification strategies ask them."""

from typing import Any

import torch
from torch import Tensor

from nrfgs_ns.image import robust
from nrfgs_ns.rasterizer import changes_without


class TrainingPictures:
    """Training views rendered at the step's resolution, without view noise and exposure, over a constant background.

    Pixels outside the mask, and those that the robust loss ignores, do not count.

    Args:
        model: an NrfgsModel in training mode.
        datamanager: with its images.
    """

    def __init__(self, model, datamanager: Any):
        self.model, self.datamanager = model, datamanager

    def __len__(self) -> int:
        return len(self.datamanager.train_dataset)

    @torch.no_grad()
    def changes_without(self, index: int, generator: torch.Generator, passes: int) -> tuple[Tensor, Tensor]:
        """See `densification.TrainingViews`."""
        model = self.model
        camera, batch = self.datamanager.train_view(index)
        field, background = model.field, model.background_color.to(model.device)
        view = model.project(camera, field.splats)
        appearance = field.seen_from(view)
        counted = model.mask_of(batch)
        if counted is None:
            size = view.projection.height, view.projection.width, 1
            counted = torch.ones(size, dtype=torch.bool, device=model.device)
        if model.trimming is not None and model.schedule_step >= robust.FIRST_STEP:
            outputs, _ = model.picture(view, appearance, camera, background)
            counted = counted & (model.trimming.kept(outputs["rgb"], model.truth_of(batch, background)) > 0.5)
        changes = changes_without(
            view.projection, *appearance, counted[None], generator, backgrounds=background[None], passes=passes
        )
        return view.visible, changes
