# SPDX-License-Identifier: Apache-2.0
"""Splats that are turned, scaled and moved look the same from a camera that is, too."""

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from torch.testing import assert_close

from nrfgs_ns.data.world import CaptureFrame
from nrfgs_ns.export.frames import NOWHERE, Y_DOWN, Similarity, to_capture
from nrfgs_ns.export.ply import on_screen, render_splats
from nrfgs_ns.model.harmonics_fit import PlainSplats

pytestmark = pytest.mark.usefixtures("no_cuda")


def random_rotation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    return q * torch.det(q)


def splats(count: int = 40) -> PlainSplats:
    torch.manual_seed(1)
    return PlainSplats(
        means=torch.randn(count, 3),
        quats=torch.nn.functional.normalize(torch.randn(count, 4), dim=-1),
        scales=torch.randn(count, 3) * 0.3 - 1.5,
        opacities=torch.randn(count, 1),
        features_dc=torch.randn(count, 3),
        features_rest=torch.randn(count, 15, 3) * 0.3,
    )


def camera(similarity: Similarity) -> Cameras:
    """Five units before the middle, in a world that was moved."""
    pose = torch.eye(4, dtype=torch.float64)[:3]
    pose[2, 3] = 5.0
    moved = torch.cat([similarity.rotation @ pose[:, :3], similarity.scale * similarity.rotation @ pose[:, 3:]], dim=1)
    moved[:, 3] += similarity.translation
    return Cameras(moved[None].float(), fx=60.0, fy=60.0, cx=24.0, cy=18.0, width=48, height=36)[0:1]


@pytest.mark.parametrize(
    "similarity",
    [
        Y_DOWN,
        *(Similarity(random_rotation(seed), 3.0**seed, torch.randn(3, dtype=torch.float64)) for seed in (-1, 0, 1)),
        # Half turns, where quaternions have no scalar part.
        Similarity(torch.diag(torch.tensor([1.0, -1.0, -1.0]).double()), 1.0, torch.zeros(3).double()),
        Similarity(torch.diag(torch.tensor([-1.0, -1.0, 1.0]).double()), 1.0, torch.zeros(3).double()),
    ],
)
def test_the_picture_is_the_same(similarity):
    background, original = torch.zeros(3), splats()
    expected = render_splats(original, camera(NOWHERE), background)
    assert expected.std() > 0.1
    moved = similarity.moved(original)
    found = render_splats(moved, camera(similarity), background, scene_unit=similarity.scale)
    # Forty splats' float32 colours and shapes, each rounded a few times at 1e-7 of numbers of up to 10.
    assert_close(found, expected, rtol=0, atol=2e-4)
    back = similarity.inverse.moved(moved)
    for name, value in back._asdict().items():
        if name == "quats":  # of two opposite ones either is the rotation
            value = value * (value * original.quats).sum(-1, keepdim=True).sign()
        assert_close(value, getattr(original, name), rtol=1e-5, atol=2e-6, msg=name)


def test_nowhere_is_to_the_bit():
    original = splats()
    assert NOWHERE.inverse.moved(NOWHERE.moved(original)) is original


def test_coordinates_of_the_earth_keep_their_precision():
    """Less the frame's origin, which the file's header tells."""
    rotation = random_rotation(3).numpy()
    center = np.array([448_262.3, 5_412_345.6, 311.2])
    frame = CaptureFrame(rotation, -rotation @ center, 0.25, np.round(center))
    original = splats()
    found = to_capture(frame).moved(original).means.double().numpy() + frame.origin
    # Float32 numbers below 20.
    np.testing.assert_allclose(found, frame.to_capture(original.means.numpy()), rtol=0, atol=2e-6)


def test_on_screen_is_what_sparks_shader_keeps():
    """|x| <= 1.4 w in clip space: the middle of the picture is 0, its edges are 1."""
    edge = 24 / 60 * 5  # half of the picture's width at five units
    x = torch.tensor([0.0, 1.0, 1.39, 1.41, -1.39, -1.41]) * edge
    means = torch.stack([x, torch.zeros(6), torch.zeros(6)], dim=-1)
    behind = torch.tensor([[0.0, 0.0, 6.0]])
    found = on_screen(torch.cat([means, behind]), camera(NOWHERE))
    assert found.tolist() == [True, True, True, False, True, False, False]
