# SPDX-License-Identifier: Apache-2.0
"""Captures in coordinates of the earth, and whether cameras see what training starts from."""

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from small_capture import Capture

from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
from nrfgs_ns.data.dataparser import place
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.frames import to_capture

UTM = np.array([448_262.3, 5_412_345.6, 311.2])


def with_points(folder, offset=0.0) -> tuple[Capture, np.ndarray]:
    capture = Capture(folder, images=10)
    xyz = np.random.default_rng(1).normal((5, 6, 7), 0.5, (40, 3)) + offset
    for frame in capture.meta["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, 3] += offset
        frame["transform_matrix"] = matrix.tolist()
    capture.add_ply(xyz)
    return capture, xyz


def datamanager(capture):
    return NrfgsDatamanagerConfig(dataparser=capture.parser(load_3D_points=False).config).setup(device="cpu")


@pytest.mark.parametrize("orientation", ["up", "pca", "vertical", "none"])
@pytest.mark.parametrize("center", ["poses", "focus"])
def test_coordinates_of_the_earth_lose_nothing(tmp_path, orientation, center):
    options = {"orientation_method": orientation, "center_method": center}
    near, _ = with_points(tmp_path / "near")
    far, xyz = with_points(tmp_path / "far", UTM)
    near, far = near.parse(**options), far.parse(**options)
    # Both are float32 numbers below 2 after some sums of numbers below 10.
    torch.testing.assert_close(far.cameras.camera_to_worlds, near.cameras.camera_to_worlds, atol=1e-5, rtol=0)
    torch.testing.assert_close(far.metadata["points3D_xyz"], near.metadata["points3D_xyz"], atol=1e-5, rtol=0)
    assert far.dataparser_scale == pytest.approx(near.dataparser_scale, rel=1e-6)
    # The way back: float32 numbers below 2 in units of three metres, and float64 at 5,000,000.
    back, origin = to_capture(far)
    np.testing.assert_allclose(back.places(far.metadata["points3D_xyz"]) + origin, xyz, atol=1e-5, rtol=0)
    assert np.abs(origin - UTM - (5, 6, 7)).max() < 4 and (origin == np.round(origin)).all()
    assert (to_capture(near)[1] == 0).all()


def test_poses_are_where_the_transform_leads():
    """With pca nerfstudio also mirrors the second and the third camera, as here."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, :3] = Rotation.random(8, random_state=0).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(8, 3))
    placed, transform, scale = place(poses, "pca", "poses", True, 1.0)
    np.testing.assert_allclose(placed, transform.double().numpy() @ poses * [1, 1, 1, scale], atol=1e-5)


def test_an_applied_transform_is_part_of_the_way_back(tmp_path):
    """The capture's own world is that from before it."""
    far, xyz = with_points(tmp_path / "far", UTM)
    turn = Rotation.random(random_state=3).as_matrix()
    far.meta["applied_transform"] = np.column_stack([turn, (3, 4, 5)]).tolist()
    outputs = far.parse()
    back, origin = to_capture(outputs)
    found = back.places(outputs.metadata["points3D_xyz"]) + origin
    np.testing.assert_allclose(found, (xyz - (3, 4, 5)) @ turn, atol=1e-5, rtol=0)


def test_nerfstudio_leads_poses_back(tmp_path):
    far, _ = with_points(tmp_path / "far", UTM)
    outputs = far.parse()
    poses = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, "opengl")
    truth = {frame["file_path"][-7:]: np.array(frame["transform_matrix"]) for frame in far.meta["frames"]}
    for path, pose in zip(outputs.image_filenames, poses.numpy(), strict=True):
        np.testing.assert_allclose(pose, truth[path.name][:3], atol=1e-5, rtol=0)


def turn_away(frame) -> None:
    frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * [-1, 1, -1, 1]).tolist()


def test_views_without_a_point_are_named_and_most_views_must_have_some(tmp_path, printed):
    capture, _ = with_points(tmp_path / "scene")
    for frame in capture.meta["frames"][:3]:
        turn_away(frame)
    capture.parse(eval_mode="all")
    assert "3 of 10 training views see none of the 40 points" in (text := printed()) and "009.png" in text
    for frame in capture.meta["frames"][3:7]:
        turn_away(frame)
    with pytest.raises(InputError, match="7 of 10 training views see none of the 40 points"):
        capture.parse(eval_mode="all")


@pytest.mark.parametrize("spread", [0.0, 0.01])
def test_points_of_hardly_any_spread_start_nothing(tmp_path, spread):
    capture, xyz = with_points(tmp_path / "scene")
    capture.add_ply(np.concatenate([(5, 6, 7) + spread * (xyz[:30] - (5, 6, 7)), xyz[30:]]))
    with pytest.raises(InputError, match=r"transforms.json: the 40 points to start from .*--load-3D-points False"):
        capture.parse()
    capture.add_ply((5, 6, 7) + 0.1 * (xyz - (5, 6, 7)))
    assert len(capture.parse().metadata["points3D_xyz"]) == 40


def test_empty_masks_are_named(tmp_path, printed):
    capture = Capture(tmp_path / "scene", images=10)
    capture.add_masks()
    for name in ("003.png", "004.png"):  # for training and for testing
        Image.new("L", (12, 9)).save(capture.folder / "masks" / name)
    datamanager(capture).load_all_images()
    text = printed()
    assert all(f"masks or transparency leave nothing of {name}." in text for name in ("003.png", "004.png"))
    for path in (capture.folder / "masks").iterdir():
        Image.new("L", (12, 9)).save(path)
    with pytest.raises(InputError, match="leave nothing of 000.png, 001.png, 002.png and 6 more"):
        datamanager(capture).load_all_images()


@pytest.mark.parametrize("k1", [0.0, 0.05])
def test_a_fisheye_is_undistorted(tmp_path, k1):
    """What is in memory is what a pinhole sees of a world whose colour depends on direction."""
    side, focal = 96, 60.0

    def seen(x, y):  # smooth in the direction (x, y, 1)
        return np.stack([128 + 100 * np.sin(3 * x), 128 + 100 * np.cos(2 * y + x), 0 * x + 50], axis=-1)

    capture = Capture(tmp_path / "scene", images=3)
    capture.meta |= {"w": side, "h": side, "cx": side / 2, "cy": side / 2, "fl_x": focal, "fl_y": focal}
    capture.meta |= {"camera_model": "OPENCV_FISHEYE", "k1": k1}
    u, v = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    x, y = (u - side / 2) / focal, (v - side / 2) / focal
    distance = np.hypot(x, y)
    angle = distance.copy()
    for _ in range(20):  # distance = angle (1 + k1 angle^2)
        angle = distance / (1 + k1 * angle**2)
    stretch = np.tan(angle) / distance
    picture = Image.fromarray(seen(x * stretch, y * stretch).round().astype(np.uint8))
    for frame in capture.meta["frames"]:
        picture.save(capture.folder / frame["file_path"])
    manager = datamanager(capture)
    manager.load_all_images()
    for images, set in ((manager.cached_train, manager.train_dataset), (manager.cached_eval, manager.eval_dataset)):
        image, camera = images[0]["image"].numpy().astype(float), set.cameras[0]
        u, v = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
        x, y = (u - camera.cx.item()) / camera.fx.item(), (v - camera.cy.item()) / camera.fy.item()
        # Interpolating between pixels 1/60 apart, second derivative 900: below 0.1. Rounding twice: 1.
        assert np.abs(image - seen(x, y))[2:-2, 2:-2].max() < 2.5
        assert np.abs(image - seen(*((np.stack([u, v]) - side / 2) / focal)))[2:-2, 2:-2].max() > 10
        assert camera.camera_type.item() == 1
