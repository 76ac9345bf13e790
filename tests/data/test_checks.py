# SPDX-License-Identifier: Apache-2.0
"""Broken data sets: each must be refused with a message that names the culprit and the fix. tests/attack has more."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from nrfgs_ns.data.checks import check_poses
from nrfgs_ns.errors import InputError

LAST = "images/000.png"  # the frames are listed backwards


def pose(capture, row, column, value):
    capture.meta["frames"][2]["transform_matrix"][row][column] = value


def to_one_place(capture):
    for frame in capture.meta["frames"]:
        for row in range(3):
            frame["transform_matrix"][row][3] = 2.5


BROKEN = {  # what is done to the data set -> what the message must say
    "no file_path": (lambda c: c.meta["frames"][3].pop("file_path"), "transforms.json frames[3] file_path remove"),
    "no pose": (lambda c: c.meta["frames"][3].pop("transform_matrix"), "transform_matrix 006.png remove"),
    "3 x 4 pose": (lambda c: c.meta["frames"][2]["transform_matrix"].pop(), "transform_matrix 007.png 4 x 4 last row"),
    "NaN in pose": (lambda c: pose(c, 0, 3, float("nan")), "transform_matrix 007.png finite Give"),
    "last row": (lambda c: pose(c, 3, 0, 0.1), "transform_matrix 007.png last row"),
    "sheared pose": (lambda c: pose(c, 0, 0, 2.0), "transform_matrix 007.png rigid shear"),
    "one place": (to_one_place, "all 10 cameras same place --auto-scale-poses"),
    "no focal length": (lambda c: c.meta.pop("fl_x"), "fl_x missing 000.png camera_angle_x"),
    "twice in disguise": (
        lambda c: c.meta["frames"].append({**c.meta["frames"][0], "file_path": "./images/009.png"}),
        "009.png more than once Keep one",
    ),
    "no train list": (lambda c: c.meta.update(test_filenames=[LAST]), "test_filenames but no train_filenames Name"),
    "split of strangers": (
        lambda c: c.meta.update(train_filenames=[LAST], test_filenames=["images/x.png"]),
        "test_filenames x.png no frame",
    ),
    "one mask lacking": (lambda c: c.meta["frames"][4].pop("mask_path"), "mask_path images/005.png all-white for none"),
    "image missing": (lambda c: (c.folder / LAST).unlink(), "1 of 10 images missing 000.png Restore"),
    "image of another size": (
        lambda c: Image.new("RGB", (9, 12)).save(c.folder / "images/001.png"),
        "001.png 9 x 12 12 x 9 Use the images",
    ),
    "intrinsics of another size": (lambda c: c.meta.update(w=24, h=18), "8 images 12 x 9 24 x 18 scale w"),
    "mask missing": (lambda c: (c.folder / "masks/001.png").unlink(), "mask_path missing masks/001.png"),
}


@pytest.mark.parametrize("change, words", BROKEN.values(), ids=BROKEN.keys())
def test_refused(capture, change, words):
    capture.add_masks()
    change(capture)
    with pytest.raises(InputError) as error:
        capture.parse()
    absent = [word for word in words.split() if word not in str(error.value)]
    assert not absent, f"{absent} not in: {error.value}"


def test_data_that_is_not_there(tmp_path, capture):
    with pytest.raises(InputError, match=r"nowhere: no such file or folder.*--data or config.yml"):
        capture.parse(data=tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"transforms.json is missing.*nrfgs prepare"):
        capture.parse(data=tmp_path)
    (tmp_path / "transforms_train.json").touch()
    with pytest.raises(InputError, match="transforms.json is missing.*`blender-data` at the end"):
        capture.parse(data=tmp_path)


def test_up_directions_that_cancel(capture):
    upside_down = [[-1.0, 0.0, 0.0, 1.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    capture.meta["frames"] = capture.meta["frames"][:2]
    for frame, matrix in zip(capture.meta["frames"], (np.eye(4).tolist(), upside_down), strict=True):
        frame["transform_matrix"] = matrix
    with pytest.raises(InputError, match="--orientation-method none"):
        capture.parse()
    capture.parse(orientation_method="none")
    to_one_place(capture)
    capture.parse(orientation_method="none", auto_scale_poses=False)  # one place is fine without it


def checked(matrix: np.ndarray) -> None:
    pose = np.eye(4)
    pose[:3, :3] = matrix
    check_poses([{"file_path": "a.png", "transform_matrix": pose.tolist()}], Path("transforms.json"), need_spread=False)


quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(quaternions)
def test_every_rotation_passes_even_rounded_and_no_other_matrix(quaternion):
    matrix = Rotation.from_quat(quaternion).as_matrix()
    checked(matrix)
    # Rounding to 3 decimals moves each entry by e <= 5e-4: |R^T R - 1| <= 2 sqrt(3) e + 3 e^2 < 2e-3, of 1e-2 allowed.
    checked(matrix.round(3))
    # A scale of 1 % moves the diagonal of R^T R by 2e-2, twice what is allowed.
    with pytest.raises(InputError, match="rigid"):
        checked(1.01 * matrix)
    with pytest.raises(InputError, match="mirrors"):
        checked(matrix * [1, 1, -1])
