# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's viewer shows the model without a GPU: the page is served, and every output is an image it can show."""

import threading
import urllib.request

import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils import colormaps
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import CameraState
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer

from nrfgs_ns.studies.run import parse

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.fixture(params=["nrfgs", "nrfgs-sh"])
def viewer(request, tiny_scene, tmp_path):
    config = parse([request.param, "--data", str(tiny_scene), "--output-dir", str(tmp_path)])
    pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    viewer = Viewer(
        ViewerConfig(websocket_host="127.0.0.1"),
        log_filename=tmp_path / "viewer.txt",
        datapath=tiny_scene,
        pipeline=pipeline,
        train_lock=threading.Lock(),
    )
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed", pipeline.datamanager.eval_dataset)
    yield viewer
    viewer.viser_server.stop()


def test_page_is_served_and_every_output_can_be_shown(viewer):
    url = f"http://127.0.0.1:{viewer.viser_server.get_port()}"
    with urllib.request.urlopen(url, timeout=20) as page:
        assert page.status == 200 and b"<html" in page.read(4096).lower()

    pose = viewer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0]
    state = CameraState(fov=0.9, aspect=4 / 3, c2w=pose, camera_type=CameraType.PERSPECTIVE)
    machine = RenderStateMachine(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client=None)
    machine.state = "low_move"
    viewer.pipeline.train()
    outputs = machine._render_img(state)
    assert viewer.pipeline.model.training, "rendering for the viewer must leave a training in training mode"
    assert {"rgb", "depth", "accumulation"} <= set(outputs)
    for name, image in outputs.items():
        shown = colormaps.apply_colormap(image=image, colormap_options=viewer.control_panel.colormap_options)
        assert shown.shape[-1] == 3 and torch.isfinite(shown).all(), name
