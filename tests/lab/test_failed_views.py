# SPDX-License-Identifier: Apache-2.0
"""Suspects of a failed view: a wall before a test camera is found, and only it."""

import pytest
import torch
from short_trainings import command_line, set_up

from nrfgs_lab.failed_views import failed_views, views_that_show

pytestmark = pytest.mark.usefixtures("no_cuda")


def test_a_wall_before_a_test_camera_is_what_it_costs(tiny_scene, tmp_path):
    options = {"--pipeline.model.near-plane": "off", "--pipeline.model.num-downscales": 0}
    pipeline = set_up(command_line("nrfgs", tiny_scene, tmp_path, 1, options)).pipeline
    pipeline.eval()
    model, (camera, _) = pipeline.model, pipeline.datamanager.fixed_indices_eval_dataloader[0]
    before = failed_views(pipeline)
    name = next(iter(before))
    pose = camera.camera_to_worlds[0]
    wall = pose[:, 3] - 0.05 * model.near * pose[:, 2]  # right before the camera
    rows = torch.arange(5)
    with torch.no_grad():
        model.gauss_params["means"][rows] = wall + 1e-4 * torch.randn(5, 3)
        model.gauss_params["opacities"][rows] = 9.0
        model.gauss_params["scales"][rows] = torch.tensor(model.near).log() - 3
        model.gauss_params["features_dc"][rows] = 5.0
    after = failed_views(pipeline)
    assert after[name]["nothing"] < before[name]["nothing"] - 3
    assert after[name]["nearer than 0.5"] == pytest.approx(before[name]["nearer than 0.5"], abs=0.5)
    shown, inside = views_that_show(pipeline)
    assert shown.shape == inside.shape == (model.num_points,) and int(shown.max()) <= 8
