# SPDX-License-Identifier: Apache-2.0
"""The viewer opens without reading anything twice, and shows what it showed."""

import threading

import numpy as np
import pytest
import torch
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.viewer import Viewer
from PIL import Image

from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_ns.data.datamanager import NrfgsInputDataset
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig
from nrfgs_ns.viewer import start

pytestmark = pytest.mark.usefixtures("no_cuda")


def test_a_training_s_photographs_are_not_read_again(pipeline, tiny_scene, tmp_path, monkeypatch):
    dataset, reads, shown = pipeline.datamanager.train_dataset, [], []
    get_data, threads = NrfgsInputDataset.get_data, torch.get_num_threads()
    monkeypatch.setattr(NrfgsInputDataset, "get_data", lambda *args, **more: reads.append(1) or get_data(*args, **more))
    log, lock = tmp_path / "log", threading.Lock()
    viewer = Viewer(ViewerConfig(), log, datapath=tiny_scene, pipeline=pipeline, train_lock=lock)
    scene = viewer.viser_server.scene
    add = scene.add_camera_frustum
    monkeypatch.setattr(scene, "add_camera_frustum", lambda **what: shown.append(what["image"]) or add(**what))
    try:
        viewer.init_scene(dataset, "training")
        assert len(shown) == len(dataset) and reads == []
        assert torch.get_num_threads() == threads
        Viewer.init_scene.__wrapped__(viewer, dataset, "training")
        assert reads != []
        ours, theirs = (np.stack(some).astype(int) for some in (shown[: len(dataset)], shown[len(dataset) :]))
        assert np.abs(ours - theirs).max() <= 1, "but for the rounding of a byte"
    finally:
        viewer.viser_server.stop()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    config = SceneConfig(views=3, width=640, height=400, points=50, samples=1)
    scene = write_scene(config, tmp_path_factory.mktemp("large"))
    return NrfgsInputDataset(NrfgsDataParserConfig(data=scene).setup().get_dataparser_outputs("train"))


@pytest.mark.parametrize("read", [True, False], ids=["read", "in files"])
def test_large_photographs_come_small(dataset, read):
    images = [dataset.get_data(index, image_type="uint8") for index in range(len(dataset))] if read else None
    small = start.SmallPhotographs(dataset, images)
    assert len(small) == len(dataset) and small.cameras is dataset.cameras
    image = small[0]["image"]
    assert min(image.shape[:2]) in range(start.SIDE, 2 * start.SIDE) and image.shape[2] == 3
    whole = dataset.get_data(0)["image"].permute(2, 0, 1)[None]
    shape = tuple(image.shape[:2])
    expected = torch.nn.functional.interpolate(whole, shape, mode="area")[0].permute(1, 2, 0)
    assert (image - expected).abs().mean() < 0.03


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK"])
def test_a_photograph_of_any_mode_is_shown_in_colour(tmp_path, mode):
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.fromarray(np.full((30, 40, 3), 153, np.uint8)).convert(mode).save(path)
    dataset = type("", (), {"cameras": None, "image_filenames": [path]})()
    image = start.SmallPhotographs(dataset, None)[0]["image"]
    assert image.shape == (30, 40, 3) and (image - 153 / 255).abs().max() < 0.02
