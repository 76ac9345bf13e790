# SPDX-License-Identifier: Apache-2.0
"""Controls of the appearance head's pictures in nerfstudio's viewer.

A model with a panel (`viewer_panel`) follows it only in the viewer's render threads (`is_asking`): what a browser sets
cannot reach a training, an evaluation or ns-render.
"""

import sys
import threading
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor
from viser.transforms import SO3

from nrfgs_ns.viewer.pictures import FULL, legends, picture
from nrfgs_ns.viewer.server import protect
from nrfgs_ns.viewer.start import open_sooner

STEP_FORWARD = 5.0
"""Distance of a browser's first view in front of the first photograph, in sizes of the frustums that mark photographs.
Frustums of 30 degrees and more then lie behind it."""
MEAN_LOOK = "all photographs' mean"


class ViewerPanel(ViewerControl):
    """The folder "Appearance" at the top of nerfstudio's viewer, which finds it as an attribute of the model."""

    def __init__(self, model):
        protect()
        open_sooner()
        self.model = model
        self.background: Tensor | None = None
        """the viewer's background colour [3]"""
        self.frozen_center: Tensor | None = None
        """camera centre [3] where the view was frozen"""

    def _setup(self, viewer) -> None:
        """Add the controls; nerfstudio calls this after its own."""
        super()._setup(viewer)
        self.legends = legends(self.model.field)
        gui = viewer.viser_server.gui
        with gui.add_folder("Appearance", order=viewer.stats_markdown.order + 0.5):
            self.mode = gui.add_dropdown("Show", list(self.legends), initial_value=FULL, hint="What is drawn")
            self.legend = gui.add_markdown(self.legends[FULL])
            hint = "How much of the view dependence is added: 0 nothing, 1 as trained"
            self.gain = gui.add_slider("Residual gain", 0.0, 2.0, 0.05, 1.0, hint=hint)
            self.photographs = [] if self.model.photograph is None else self.model.photograph.names
            hint, looks = "The photograph whose exposure is shown", [MEAN_LOOK, *self.photographs]
            self.look = gui.add_dropdown("Look", looks, MEAN_LOOK, visible=len(looks) > 1, hint=hint)
            hint = "Keep the appearance that the splats have from here, and walk around them"
            self.freeze = gui.add_checkbox("Freeze view", initial_value=False, hint=hint)
            self.count = gui.add_text("Splats", initial_value=f"{self.model.num_points:,}", disabled=True)
        # One callback each: viser runs a control's callbacks in no particular order.
        self.mode.on_update(lambda _: self._change_mode())
        for control in (self.gain, self.look):
            control.on_update(lambda _: viewer._trigger_rerender())
        self.freeze.on_update(lambda event: self._freeze(event.client))
        viewer.viser_server.on_client_connect(self.welcome)

    @staticmethod
    def is_asking() -> bool:
        """Whether this code runs in a render thread of nerfstudio's viewer."""
        return isinstance(threading.current_thread(), RenderStateMachine)

    def welcome(self, client) -> None:
        """Move a browser to before the first training photograph, if the scene is open: nerfstudio's own first view may
        see nothing."""
        first = next(iter(getattr(self.viewer, "camera_handles", {}).values()), None)
        if first is None:
            return
        forward = SO3(first.wxyz).as_matrix()[:, 2]
        with client.atomic():
            client.camera.position = first.position + STEP_FORWARD * self.viewer.config.camera_frustum_scale * forward
            client.camera.wxyz = first.wxyz

    @property
    def options(self) -> dict[str, Any]:
        """Options of `picture` that the controls name."""
        center = self.frozen_center if self.freeze.value else None
        photograph = None if self.look.value == MEAN_LOOK else self.photographs.index(self.look.value)
        named = {"mode": self.mode.value, "gain": float(self.gain.value)}
        return named | {"frozen_center": center, "photograph": photograph}

    def render(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render one camera, a batch of one, as the controls say (`picture`)."""
        # As in nerfstudio, the viewer's background is used where the configuration leaves it open.
        background = self.background if self.model.config.background_color == "random" else None
        self.model.set_crop(obb_box)
        trace = sys.gettrace()  # nerfstudio's, which interrupts a rendering by an exception at any line
        sys.settrace(trace if self.is_slow else None)
        try:
            return picture(self.model, camera, background=background, **self.options)
        finally:
            self.model.set_crop(None)
            sys.settrace(trace)

    @property
    def is_slow(self) -> bool:
        """Whether pictures may be interrupted. On a GPU an interrupted trial of a kernel would count as failed."""
        return self.model.device.type == "cpu"

    def update_count(self) -> None:
        """Show the number of splats. Not while rendering: an interruption inside viser would leave a lock taken."""
        if self.count.value != (count := f"{self.model.num_points:,}"):
            self.count.value = count

    def _change_mode(self) -> None:
        self.legend.content = self.legends[self.mode.value]
        self.viewer._trigger_rerender()

    def _freeze(self, client) -> None:
        """Store the position of the client's camera; None: a program sets `frozen_center` itself."""
        if self.freeze.value and client is not None:
            position = client.camera.position / VISER_NERFSTUDIO_SCALE_RATIO
            self.frozen_center = torch.tensor(position, dtype=torch.float32)
        self.viewer._trigger_rerender()
