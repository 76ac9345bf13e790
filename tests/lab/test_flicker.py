# SPDX-License-Identifier: Apache-2.0
"""What is compared between frames."""

from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from nrfgs_lab.flicker import flicker, warped
from nrfgs_ns.rasterizer import Pinhole, world_to_camera

K = torch.tensor([[[20.0, 0, 8.0], [0, 20.0, 6.0], [0, 0, 1]]])


def at(x: float) -> tuple[Pinhole, dict[str, torch.Tensor]]:
    """A camera at (x, 0, 3), and what it shows of a wall at z = 0 with colours that are linear in the place."""
    pose = torch.eye(3, 4)
    pose[:, 3] = torch.tensor([x, 0.0, 3.0])
    camera = Pinhole(world_to_camera(pose[None]), K, 16, 12, pose[:, 3])
    rays = camera.rays()
    places = camera.center - 3.0 * rays / rays[..., 2:]
    shown = {"rgb": 0.5 + 0.2 * places, "depth": torch.full((12, 16, 1), 3.0), "accumulation": torch.ones(12, 16, 1)}
    return camera, shown


def test_a_wall_is_warped_onto_itself():
    (camera, frame), (other, shown) = at(0.0), at(0.15)  # by one pixel
    rgb, same = warped(camera, frame, other, shown)
    assert same[:, 1:].all() and not same[:, 0].any(), "its first column has left the other picture"
    assert_close(rgb[same], frame["rgb"][same])
    shown["depth"][3, 4] = 2.0  # something stands in front
    shown["accumulation"][5, 6] = 0.5
    assert int(warped(camera, frame, other, shown)[1].sum()) == int(same.sum()) - 2


@pytest.mark.parametrize("brighter, change, jitter", [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 2.0, 2.0)])
def test_steady_change_is_no_flicker(brighter, change, jitter):
    """Frames that become brighter by a step each, or that are by turns a step brighter and darker than the wall."""
    frames = []

    def render(camera):
        seen = at(float(camera.camera_to_worlds[0, 0, 3]))[1]
        frames.append(len(frames))
        seen["rgb"] = seen["rgb"] + (brighter * frames[-1] if brighter >= 0 else (-1) ** frames[-1]) / 255
        return seen

    poses = torch.eye(3, 4).repeat(2, 1, 1, 1)
    poses[..., 2, 3], poses[1, ..., 0, 3] = 3.0, 0.45
    model = SimpleNamespace(pinhole=lambda c: at(float(c.camera_to_worlds[0, 0, 3]))[0], get_outputs_for_camera=render)
    means = flicker(model, [SimpleNamespace(camera_to_worlds=pose) for pose in poses], 4)
    assert means["change"] == pytest.approx(change, abs=1e-3) and means["flicker"] == pytest.approx(jitter, abs=1e-3)
    assert means["compared"] == pytest.approx(14 / 16)
