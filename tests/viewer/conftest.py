# SPDX-License-Identifier: Apache-2.0
import threading

import pytest
from nerfstudio.viewer.viewer import Viewer
from short_trainings import untrained

from nrfgs_ns.viewer.server import LocalViewerConfig


@pytest.fixture(scope="module")
def pipeline(tiny_scene, tmp_path_factory):
    return untrained(tiny_scene, tmp_path_factory.mktemp("out")).eval()


@pytest.fixture(scope="module")
def open_viewer(tiny_scene, tmp_path_factory):
    """Open nerfstudio's viewer of a pipeline, and its scene."""
    opened = []

    def start(pipeline, config=None) -> Viewer:
        log, config = tmp_path_factory.mktemp("viewer") / "log.txt", config or LocalViewerConfig()
        viewer = Viewer(config, log, datapath=tiny_scene, pipeline=pipeline, train_lock=threading.Lock())
        opened.append(viewer)
        viewer.init_scene(pipeline.datamanager.train_dataset, "completed", pipeline.datamanager.eval_dataset)
        return viewer

    yield start
    for viewer in opened:
        viewer.viser_server.stop()
