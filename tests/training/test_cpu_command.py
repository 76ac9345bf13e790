# SPDX-License-Identifier: Apache-2.0
"""The command that is offered where there is no CUDA device."""

import json

import pytest

from nrfgs_ns.training.cpu_command import scale_for, ten_minute_command


@pytest.mark.parametrize(
    ("content", "scale"),
    [
        ({"w": 4032, "h": 3024, "frames": [{}]}, 0.06),
        ({"frames": [{"w": 540, "h": 960}]}, 0.25),
        ({"w": 48, "h": 36, "frames": [{}]}, 1.0),
        ({"w": 0, "h": 0, "frames": [{}]}, 0.25),
        ({"frames": []}, 0.25),
        ([], 0.25),
    ],
)
def test_the_scale_fits_the_photographs(content, scale, tmp_path):
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert scale_for(tmp_path) == scale_for(tmp_path / "transforms.json") == scale
    assert ten_minute_command(tmp_path).endswith(
        f"--data {tmp_path} --time-budget 10 --pipeline.datamanager.camera-res-scale-factor {scale:g}"
    )


def test_a_folder_without_transforms_has_a_command_too(tmp_path):
    assert "--time-budget 10" in ten_minute_command(tmp_path / "nowhere")
