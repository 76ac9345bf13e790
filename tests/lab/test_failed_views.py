# SPDX-License-Identifier: Apache-2.0
"""What test views lose without suspect splats."""

import json
import shutil

import pytest
import torch
from short_trainings import PLAIN, command_line, trained

from nrfgs_lab.failed_views import failed_views, seen_in_training
from nrfgs_ns.trained.loading import load_model

pytestmark = pytest.mark.usefixtures("no_cuda")


def loaded(scene, folder, **changed):
    """A short training's pipeline, with another content of transforms.json; None takes an entry away."""
    data = shutil.copytree(scene, folder / "data")
    meta = json.loads((data / "transforms.json").read_text()) | changed
    (data / "transforms.json").write_text(json.dumps({key: value for key, value in meta.items() if value is not None}))
    more = {"--pipeline.model.num-random": 300, "--pipeline.model.near-plane": "off"}
    return load_model(trained(command_line("nrfgs", data, folder, 2, PLAIN, more)), "test")


def test_a_splat_before_a_camera_is_found_and_left_out(tiny_scene, tmp_path):
    """Also where lenses distort, by the cameras of the undistorted images, which are known once these are read."""
    pipeline = loaded(tiny_scene, tmp_path, k1=-0.3)
    splats, data = pipeline.model.gauss_params, pipeline.datamanager
    with torch.no_grad():
        pose = data.eval_dataset.cameras.camera_to_worlds[0]
        splats["means"][7] = pose[:, 3] - 0.05 * pose[:, 2]
        splats["opacities"][7], splats["scales"][7], splats["features_dc"][7] = 8.0, -3.0, 9.0
        seen = seen_in_training(pipeline)
        assert int(data.train_dataset.cameras.width.max()) < 48
        assert torch.equal(seen.nan_to_num(), seen_in_training(pipeline).nan_to_num())
    first, second = failed_views(pipeline).values()
    assert first["nearer than 0.3"] > first["nothing"] + 1 and second["nearer than 0.3"] == second["nothing"]


def test_a_capture_without_points_has_nothing_near(tiny_scene, tmp_path):
    for row in failed_views(loaded(tiny_scene, tmp_path, ply_file_path=None)).values():
        assert row["nearer than 0.8"] == row["beside"] == row["nothing"] != row["in 1 image"]
