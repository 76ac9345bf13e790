# SPDX-License-Identifier: Apache-2.0
"""What test views lose without suspect splats."""

import pytest
import torch
from short_trainings import untrained

from nrfgs_lab.failed_views import failed_views, seen_in_training


@pytest.mark.usefixtures("no_cuda")
def test_a_splat_before_a_camera_is_found_and_left_out_and_without_points_nothing_is_near(capture, tmp_path):
    """Also where lenses distort: by the cameras of the undistorted images."""
    capture.meta["k1"] = -0.3
    for near in (True, False):
        if near:
            capture.add_ply(capture.rng.normal((5.0, 6.0, 7.0), 0.5, (300, 3)))
        else:
            del capture.meta["ply_file_path"]
        capture.save()
        options = ("--pipeline.model.near-plane", "off", "--pipeline.model.num-random", 300)
        pipeline = untrained(capture.folder, tmp_path, "nrfgs", *options, mode="test").eval()
        data, splats = pipeline.datamanager, pipeline.model.gauss_params
        pose = data.eval_dataset.cameras.camera_to_worlds[0]
        with torch.no_grad():
            splats["means"][7] = pose[:, 3] - 0.05 * pose[:, 2]
            splats["opacities"][7], splats["scales"][7], splats["features_dc"][7] = 8.0, -3.0, 9.0
            seen = seen_in_training(pipeline).nan_to_num()
            assert int(data.train_dataset.cameras.width.max()) < capture.width
            assert torch.equal(seen, seen_in_training(pipeline).nan_to_num())
        (view,) = failed_views(pipeline).values()
        assert (view["nearer than 0.8"] > view["nothing"] + 1) == (view["nearer than 0.8"] != view["nothing"]) == near
