# SPDX-License-Identifier: Apache-2.0
"""What training views say of the splats that they see, for strategies that ask."""

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.image import robust
from nrfgs_ns.model.renderer import View
from nrfgs_ns.rasterizer import changes_without


class TrainingPictures:
    """The training views of a model as they are rendered: at the resolution of the step, on a background that does not
    change, from the camera's own centre without view noise, and without the photograph's own look. What a mask leaves
    out, and what the robust loss takes for no part of the scene, does not count.

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
        field = model.field
        view = model.project(camera, field.splats)
        appearance = field.seen_from(view)
        changes = changes_without(
            view.projection,
            appearance.colors,
            appearance.opacities,
            self._counted(camera, batch, view, appearance)[None],
            generator,
            backgrounds=model.background_color.to(model.device)[None],
            passes=passes,
        )
        return view.visible, changes

    def _counted(self, camera: Cameras, batch: Mapping[str, Any], view: View, appearance: SplatAppearance) -> Tensor:
        """Which pixels count: bool [H, W, 1]."""
        model, mask = self.model, self.model.mask_of(batch)
        size = (view.projection.height, view.projection.width, 1)
        counted = torch.ones(size, dtype=torch.bool, device=model.device) if mask is None else mask
        if model.trimming is not None and model.schedule_step >= robust.FIRST_STEP:
            background = model.background_color.to(model.device)
            outputs, _ = model.picture(view, appearance, camera, background)
            counted = counted & (model.trimming.kept(outputs["rgb"], model.truth_of(batch, background)) > 0.5)
        return counted
