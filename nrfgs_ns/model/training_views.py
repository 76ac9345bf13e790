# SPDX-License-Identifier: Apache-2.0
"""What training views say of the splats that they see, for strategies that ask while they refine."""

import math
from typing import Any

import torch
from torch import Tensor

from nrfgs_ns.densification import Seen
from nrfgs_ns.image import robust
from nrfgs_ns.image.ssim import photometric_loss
from nrfgs_ns.rasterizer import changes_without, contributions


def wrong_pixels(error: Tensor, counted: Tensor, wrong: float) -> Tensor:
    """Pixels whose error is large, bool [H, W, 1].

    Args:
        error: [H, W, 1].
        counted: which pixels count, bool [H, W, 1].
        wrong: how large, as a share of the way from the smallest of those that count to the largest.
    """
    least = error.where(counted, math.inf).amin()
    most = error.where(counted, -math.inf).amax()
    return counted & (error - least > wrong * (most - least))


class ComparedViews:
    """A training's views, compared with their photographs as its loss compares them.

    That is at the resolution of the step, with the photograph's look where that is learnt, and on a background that
    does not change; from the camera's own centre, without view noise. What a mask leaves out, and what the robust loss
    takes for no part of the scene, has no error, and shows no splat. Pixels are counted at the photograph's size.

    Args:
        model: an NrfgsModel in training mode.
        datamanager: with its images.
    """

    def __init__(self, model, datamanager: Any):
        self.model, self.datamanager = model, datamanager

    def __len__(self) -> int:
        return len(self.datamanager.train_dataset)

    @torch.no_grad()
    def look(self, index: int, wrong: float) -> Seen:
        """See `densification.TrainingViews`."""
        model = self.model
        camera, batch = self.datamanager.train_view(index)
        field = model.field
        view = model.project(camera, field.splats)
        appearance = field.seen_from(view)
        outputs, truth = model.against_photograph(camera, batch, view, appearance)
        rgb, counted = outputs["rgb"], self._counted(outputs["rgb"], truth, model.mask_of(batch))
        high = wrong_pixels((rgb - truth).abs().mean(dim=-1, keepdim=True), counted, wrong)
        maps = torch.cat([counted, high], dim=-1)[None].to(rgb.dtype)
        area = float(model._get_downscale_factor() ** 2)  # of a rendered pixel, in the photograph's
        pixels, of_those = (area * contributions(view.projection, appearance.opacities, maps)).unbind(dim=-1)
        loss = photometric_loss(rgb * counted, truth * counted, model.config.ssim_lambda)
        return Seen(view.visible, pixels, of_those, loss)

    @torch.no_grad()
    def changes_without(self, index: int, generator: torch.Generator, passes: int) -> tuple[Tensor, Tensor]:
        """See `densification.TrainingViews`."""
        model = self.model
        camera, batch = self.datamanager.train_view(index)
        field = model.field
        view = model.project(camera, field.splats)
        appearance = field.seen_from(view)
        outputs, truth = model.against_photograph(camera, batch, view, appearance)
        changes = changes_without(
            view.projection,
            appearance.colors,
            appearance.opacities,
            self._counted(outputs["rgb"], truth, model.mask_of(batch))[None],
            generator,
            backgrounds=model.background_color.to(model.device)[None],
            passes=passes,
        )
        return view.visible, changes

    def _counted(self, rgb: Tensor, truth: Tensor, mask: Tensor | None) -> Tensor:
        """Which pixels count: bool [H, W, 1]."""
        model = self.model
        counted = torch.ones_like(rgb[..., :1], dtype=torch.bool) if mask is None else mask
        if model.trimming is not None and model.schedule_step >= robust.FIRST_STEP:
            counted = counted & (model.trimming.kept(rgb, truth) > 0.5)
        return counted
