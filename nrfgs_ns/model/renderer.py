# SPDX-License-Identifier: Apache-2.0
"""How a model draws what a camera sees: geometry -> head -> rasterizer -> image.

`look` projects the splats into the camera, the head says what the visible ones look like from there, and `paint`
composites them over the background. Nothing here needs CUDA.
"""

import os
from functools import cached_property
from typing import Any, NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.pinhole import Pinhole, pinhole
from nrfgs_ns.rasterizer import Projection, composite, project
from nrfgs_ns.viewer.panel import asked_by_viewer

NEAR_PLANE, FAR_PLANE = 0.01, 1e10
"""Depths between which splats are drawn, in scene units: splatfacto's."""
LOOK = "NRFGS_LOOK"
"""Environment variable: the training photograph whose exposure and colour renderings have; the mean look without it."""


class View(NamedTuple):
    """One camera as the rasterizer wants it, and what it sees."""

    projection: Projection
    """the visible splats on the image plane, M of them"""
    splats: dict[str, Tensor]
    """the table of splats that was projected: all of them, or those in the crop box"""
    center: Tensor
    """camera centre in world coordinates, [3]"""

    @property
    def visible(self) -> Tensor:
        """Rows of `splats` that are visible, int64 [M]."""
        return self.projection.gaussian_ids


class Rendering:
    """The part of `NrfgsModel` that draws; it needs the rest: splats, head, configuration, densification."""

    @cached_property
    def _pinholes(self) -> dict[tuple[int, int], Pinhole]:
        """Training cameras by index and downscale."""
        return {}

    def _get_downscale_factor(self) -> int:
        if not self.training:
            return 1
        risen = self.schedule_step // self.config.resolution_schedule
        return 2 ** max(self.config.num_downscales - risen, 0)

    def look(self, camera: Cameras, splats: dict[str, Tensor] | None = None) -> View:
        """Project the splats into one camera.

        Args:
            camera: a batch of one camera, [1].
            splats: another table than the model's own.
        """
        splats = self._splats_to_draw() if splats is None else splats
        seen_from = self._pinhole(camera)
        projection = self._project(splats, seen_from.viewmat, seen_from.K, seen_from.width, seen_from.height)
        return View(projection, splats, seen_from.center)

    def _splats_to_draw(self) -> dict[str, Tensor]:
        """The table of splats: all of them, or those in the crop box; with "diffuse" (`appearance/diffuse.py`) if it is
        known which are."""
        splats: dict[str, Tensor] = dict(self.gauss_params.items())
        if (diffuse := self.densification.state.get(DIFFUSE)) is not None:
            splats[DIFFUSE] = diffuse
        if self.crop_box is not None and not self.training:
            inside = self.crop_box.within(splats["means"]).reshape(-1)
            splats = {name: value[inside] for name, value in splats.items()}
        return splats

    def _project(self, splats: dict[str, Tensor], viewmats: Tensor, Ks: Tensor, width: int, height: int) -> Projection:
        """Project a table of splats into cameras [C, 4, 4], [C, 3, 3] of one size."""
        if self.config.rasterize_mode not in ("antialiased", "classic"):
            raise InputError(
                f"pipeline.model.rasterize_mode is {self.config.rasterize_mode!r}; use 'classic' or 'antialiased'."
            )
        return project(
            splats["means"],
            splats["quats"],
            splats["scales"].exp(),
            viewmats,
            Ks,
            width,
            height,
            near_plane=NEAR_PLANE * self.scene_unit,
            far_plane=FAR_PLANE * self.scene_unit,
            rasterize_mode=self.config.rasterize_mode,
            assume_finite=self.training,  # the trainer's guard watches
        )

    def _pinhole(self, camera: Cameras) -> Pinhole:
        """The camera for the rasterizer; training cameras whose pose is not learnt are converted once."""
        downscale = self._get_downscale_factor()
        if not self.training:
            pose = camera.camera_to_worlds.reshape(1, *camera.camera_to_worlds.shape[-2:])
            return pinhole(camera, pose.to(self.device), downscale)
        assert camera.shape[0] == 1, "Only one camera at a time"
        index = (camera.metadata or {}).get("cam_idx")
        if index is None or self.camera_optimizer.config.mode != "off":
            return pinhole(camera, self.camera_optimizer.apply_to_camera(camera), downscale)
        if (index, downscale) not in self._pinholes:
            self._pinholes[index, downscale] = pinhole(camera, camera.camera_to_worlds, downscale)
        return self._pinholes[index, downscale]

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera.

        Returns:
            "rgb" [H, W, 3] in [0, 1], "accumulation" [H, W, 1], "background" [3] in training and [H, W, 3] otherwise,
            and "depth" [H, W, 1], which is left out of training unless `output_depth_during_training`.
        """
        view = self.look(camera)
        splats = self.view_noise.moved(view.splats, self.step) if self.training else view.splats
        appearance = self.head(splats, view.visible, view.center)
        outputs, self.info = self.paint(view, appearance, photograph=self._photograph_of(camera))
        if self.training:
            self.densification.pre_backward(self.step, self.info, appearance.opacities, self.gauss_params["opacities"])
            self._correct_colors(outputs, camera)
        return outputs

    def _photograph_of(self, camera: Cameras) -> int | None:
        """Which photograph's look a rendering has: in training, the one that the camera took; None: the mean look."""
        if self.photograph is None:
            return None
        if self.training:
            return (camera.metadata or {}).get("cam_idx")
        name = os.environ.get(LOOK)
        if name and name not in self.photograph.names:
            raise InputError(
                f"{LOOK} is {name!r}, which is none of the training photographs, such as {self.photograph.names[0]!r}."
            )
        return self.photograph.names.index(name) if name else None

    def _correct_colors(self, outputs: dict[str, Tensor], camera: Cameras) -> None:
        """Apply the training camera's bilateral grid to "rgb", if there are grids."""
        if self.config.use_bilateral_grid and "cam_idx" in (camera.metadata or {}):
            height, width = outputs["rgb"].shape[:2]
            index = camera.metadata["cam_idx"]
            outputs["rgb"] = self._apply_bilateral_grid(outputs["rgb"][None], index, height, width)[0]

    @torch.no_grad()
    def get_base_color(self, camera: Cameras) -> Tensor:
        """The image [H, W, 3] of the base colours and opacities alone, without what depends on the view."""
        view = self.look(camera)
        return self.paint(view, self.head.base_appearance(view.splats, view.visible))[0]["rgb"]

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render one camera as it was trained; for a browser, as the viewer's panel says (`viewer.py`).

        Args:
            camera: a batch of one camera, [1].
            obb_box: only splats with their centre inside are drawn, if given.
        """
        if asked_by_viewer():
            return self.viewer_panel.render(camera.to(self.device), obb_box)
        return super().get_outputs_for_camera(camera, obb_box)

    def set_background(self, background_color: Tensor) -> None:
        """Take the viewer's background [3], for the viewer's pictures alone: what evaluation uses must not change."""
        self.viewer_panel.background = background_color

    def paint(
        self,
        view: View,
        appearance: SplatAppearance,
        background: Tensor | None = None,
        photograph: int | None = None,
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Composite the visible splats over the background.

        Args:
            view: what one camera sees.
            appearance: colours and opacities of the M visible splats.
            background: a colour [3] instead of the configuration's.
            photograph: the picture has the look of this one; None: the mean look.

        Returns:
            As `get_outputs`; and the rasterizer's `info`, for densification.
        """
        with_depth = self.config.output_depth_during_training or not self.training
        if background is None:
            background = self._get_background_color()
        render, alpha, info = composite(
            view.projection,
            appearance.colors,
            appearance.opacities,
            backgrounds=background[None],
            render_mode="RGB+ED" if with_depth else "RGB",
            absgrad=self.training and self.densification.needs_absgrad(self.step),
            assume_finite=self.training,
        )
        render, alpha = render.squeeze(0), alpha.squeeze(0)  # a view; what [0] sends back is a copy among zeros
        height, width = alpha.shape[:2]
        self.last_size = (height, width)
        rgb = render[..., :3] if with_depth else render
        if photograph is not None:
            rgb = self.photograph(rgb, photograph)
        outputs = {
            "rgb": torch.clamp(rgb, 0.0, 1.0),
            "accumulation": alpha,
            "background": background if self.training else background.expand(height, width, 3),
        }
        if with_depth:
            depth = render[..., 3:4]
            outputs["depth"] = torch.where(alpha > 0, depth, depth.detach().max())
        return outputs, info
