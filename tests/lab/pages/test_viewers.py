# SPDX-License-Identifier: Apache-2.0
"""Timing of viewers, without the packages of others, which the repository does not have."""

import json

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from nrfgs_lab.pages import pictures, viewers
from nrfgs_ns.export.frames import Y_DOWN
from nrfgs_ns.export.ply import read_splats, render_splats
from nrfgs_ns.image.metrics import psnr

SIZE = (160, 96)


@pytest.mark.browser
def test_pictures_of_the_page_are_timed_on_the_way_of_the_others_cameras(tmp_path):
    pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")
    if pictures.CHROMIUM is None:
        pytest.skip("no Chromium on the path")
    viewers.write_scene(tmp_path, 12_000, SIZE, 4)  # fills more than a row of the order's texture
    record = viewers.measured(tmp_path, ("page", "base"), SIZE, 2)
    assert all(len(seconds) == 2 and min(seconds) > 0 for seconds in record["seconds"].values())
    images = record["images"]
    # The PLY file's pictures, as the other viewers would show them, from all cameras.
    splats = Y_DOWN.inverse.moved(read_splats(tmp_path / "scene.ply"))
    eyes = [[x, -z, y] for x, y, z in json.loads((tmp_path / "cameras.json").read_text())["eyes"]]
    scores = [psnr(images["base"], render_splats(splats, camera_at(eye), torch.zeros(3))) for eye in eyes]
    assert scores[3] == max(scores) > 25 and scores[3] > scores[2] + 3
    assert psnr(images["page"], images["base"]) < 35, "the field is off in both"


def camera_at(eye: list[float]) -> Cameras:
    """A camera at a place that looks at the origin."""
    back = torch.nn.functional.normalize(torch.tensor(eye), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
    pose = torch.stack([right, torch.linalg.cross(back, right), back, torch.tensor(eye)], dim=1)[None]
    focal = viewers.FOCAL * SIZE[0]
    return Cameras(pose, focal, focal, SIZE[0] / 2, SIZE[1] / 2, *SIZE)[0:1]
