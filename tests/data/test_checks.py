# SPDX-License-Identifier: Apache-2.0
"""Broken data sets: each must be refused with a message that names the culprit and the mend."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from nrfgs_ns.data.checks import SHOWN, check_poses, some
from nrfgs_ns.errors import InputError

LAST = "images/000.png"  # the frames are listed backwards


def pose(capture, row, column, value):
    capture.meta["frames"][2]["transform_matrix"][row][column] = value


def everywhere(value):
    def change(capture):
        for frame in capture.meta["frames"]:
            for row in range(3):
                frame["transform_matrix"][row][3] = value

    return change


def with_masks(change):
    def both(capture):
        capture.add_masks()
        change(capture)

    return both


def repaint(path, size, mode):
    def change(capture):
        Image.new(mode, size).save(capture.folder / path)

    return change


def spoil(path, content=b"nothing that can be decoded"):
    return lambda capture: (capture.folder / path).write_bytes(content)


META = {  # what is done to the data set -> what the message must say
    "no frames": (lambda c: c.meta.pop("frames"), "transforms.json `frames` Make"),
    "empty frames": (lambda c: c.meta.update(frames=[]), "transforms.json `frames` Make"),
    "frames not objects": (lambda c: c.meta.update(frames=["a.png"]), "transforms.json `frames` Make"),
    "no file_path": (lambda c: c.meta["frames"][3].pop("file_path"), "transforms.json frames[3] file_path remove"),
    "no pose": (lambda c: c.meta["frames"][3].pop("transform_matrix"), "transform_matrix 006.png remove"),
    "3 x 4 pose": (lambda c: c.meta["frames"][2]["transform_matrix"].pop(), "transform_matrix 007.png 4 x 4 last row"),
    "ragged pose": (lambda c: c.meta["frames"][2]["transform_matrix"][1].pop(), "transform_matrix 007.png 4 x 4"),
    "words in pose": (lambda c: pose(c, 0, 0, "one"), "transform_matrix 007.png numbers"),
    "NaN in pose": (lambda c: pose(c, 0, 3, float("nan")), "transform_matrix 007.png NaN Recompute"),
    "Inf in pose": (lambda c: pose(c, 0, 0, float("inf")), "transform_matrix 007.png Inf Recompute"),
    "last row": (lambda c: pose(c, 3, 0, 0.1), "transform_matrix 007.png last row"),
    "sheared pose": (lambda c: pose(c, 0, 0, 2.0), "transform_matrix 007.png rigid shear"),
    "one place": (everywhere(2.5), "all 10 cameras same place --auto-scale-poses"),
    "the origin": (everywhere(0.0), "all 10 cameras same place --auto-scale-poses"),
    "no focal length": (lambda c: c.meta.pop("fl_x"), "fl_x missing 009.png camera_angle_x"),
    "no width": (lambda c: c.meta.pop("w"), "w is missing Add"),
    "zero focal length": (lambda c: c.meta.update(fl_x=0.0), "fl_x top level 0.0 pixels"),
    "negative focal length": (lambda c: c.meta.update(fl_y=-3.0), "fl_y top level -3.0 pixels"),
    "NaN focal length": (lambda c: c.meta.update(fl_y=float("nan")), "fl_y nan pixels"),
    "focal length in words": (lambda c: c.meta.update(fl_x="long"), "fl_x 'long' pixels"),
    "no rows": (lambda c: c.meta.update(h=0), "h of the top level 0 pixels"),
    "distortion": (lambda c: c.meta.update(k1=float("inf")), "k1 inf 0 for none"),
    "camera model": (lambda c: c.meta.update(camera_model="PINE"), "camera_model 'PINE' OPENCV"),
    "applied_transform": (lambda c: c.meta.update(applied_transform=[[1, 0], [0]]), "applied_transform 3 x 4 remove"),
    "applied_scale": (lambda c: c.meta.update(applied_scale=0), "applied_scale positive"),
    "twice": (lambda c: c.meta["frames"].append(c.meta["frames"][0]), "009.png more than once Keep one"),
    "twice in disguise": (
        lambda c: c.meta["frames"].append({**c.meta["frames"][0], "file_path": "./images/009.png"}),
        "009.png more than once Keep one",
    ),
    "no train images": (lambda c: c.meta.update(train_filenames=[], test_filenames=[LAST]), "train_filenames"),
    "no train list": (lambda c: c.meta.update(test_filenames=[LAST]), "train_filenames"),
    "split of strangers": (
        lambda c: c.meta.update(train_filenames=[LAST], test_filenames=["images/x.png"]),
        "test_filenames x.png no frame",
    ),
    "split not a list": (lambda c: c.meta.update(train_filenames=LAST), "train_filenames list"),
    "split names twice": (
        lambda c: c.meta.update(train_filenames=[LAST, LAST]),
        "train_filenames 000.png more than once",
    ),
    "one mask lacking": (
        with_masks(lambda c: c.meta["frames"][4].pop("mask_path")),
        "mask_path images/005.png all-white for none",
    ),
    "one depth only": (lambda c: c.meta["frames"][4].update(depth_file_path="d.png"), "depth_file_path for none"),
}
FILES = {
    "first image missing": (lambda c: (c.folder / "images/009.png").unlink(), "1 of 10 images missing 009.png"),
    "image missing": (lambda c: (c.folder / LAST).unlink(), "1 of 10 images missing 000.png Restore"),
    "first image unreadable": (spoil("images/009.png"), "009.png not a readable image Restore"),
    "image unreadable": (spoil("images/001.png"), "001.png not a readable image Restore"),
    "image empty": (spoil("images/001.png", b""), "001.png not a readable image Restore"),
    "image of another size": (repaint("images/001.png", (9, 12), "RGB"), "001.png 9 x 12 12 x 9 Use the images"),
    "intrinsics of another size": (lambda c: c.meta.update(w=24, h=18), "8 images 12 x 9 24 x 18 scale w"),
    "mask missing": (with_masks(lambda c: (c.folder / "masks/001.png").unlink()), "mask_path missing masks/001.png"),
    "mask unreadable": (with_masks(spoil("masks/001.png")), "masks/001.png not a readable"),
    "mask of another size": (with_masks(repaint("masks/001.png", (6, 5), "L")), "masks masks/001.png 6 x 5 12 x 9"),
    "mask in colours": (with_masks(repaint("masks/001.png", (12, 9), "RGB")), "masks/001.png grey palette 8-bit"),
    "mask in a palette": (with_masks(repaint("masks/001.png", (12, 9), "P")), "masks/001.png grey palette 8-bit"),
}


@pytest.mark.parametrize("change, words", (META | FILES).values(), ids=(META | FILES).keys())
def test_refused(capture, change, words):
    change(capture)
    with pytest.raises(InputError) as error:
        capture.parse()
    absent = [word for word in words.split() if word not in str(error.value)]
    assert not absent, f"{absent} not in: {error.value}"


@pytest.mark.parametrize("options, word", [
    ({"eval_interval": 1}, "--eval-mode"),
    ({"eval_mode": "filename"}, "--eval-mode filename"),
    ({"eval_mode": "fraction", "train_split_fraction": 1.5}, "--eval-mode fraction"),
    ({"downscale_factor": 0}, "--downscale-factor"),
    ({"downscale_factor": 4}, "--downscale-factor 4 leaves images of 3 x 2"),
    ({"mask_color": (0.0, 0.0, 0.0)}, "--mask-color"),
])  # fmt: skip
def test_impossible_options_are_refused(capture, options, word):
    with pytest.raises(InputError, match=word):
        capture.parse(**options)


def test_data_that_is_not_there(tmp_path, capture):
    with pytest.raises(InputError, match=r"nowhere: no such file or folder.*--data"):
        capture.parse(data=tmp_path / "nowhere")
    (tmp_path / "bare").mkdir()
    with pytest.raises(InputError, match=r"transforms.json is missing.*ns-process-data"):
        capture.parse(data=tmp_path / "bare")


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe", b"", b"[]", b"3"])
def test_invalid_json(tmp_path, capture, content):
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(InputError, match=r"transforms.json"):
        capture.parse(data=tmp_path)


def test_up_directions_that_cancel(capture):
    frames = capture.meta["frames"] = capture.meta["frames"][:2]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])  # the second camera is upside down
    poses[1, 0, 3] = 1.0
    for frame, matrix in zip(frames, poses, strict=True):
        frame["transform_matrix"] = matrix.tolist()
    with pytest.raises(InputError, match="--orientation-method none"):
        capture.parse()
    capture.parse(orientation_method="none")


def test_one_place_is_fine_without_auto_scale(capture):
    everywhere(2.5)(capture)
    capture.parse(auto_scale_poses=False)


def rotation(quaternion: list[float]) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def checked(matrix: np.ndarray) -> None:
    pose = np.eye(4)
    pose[:3, :3] = matrix
    check_poses([{"file_path": "a.png", "transform_matrix": pose.tolist()}], Path("transforms.json"), need_spread=False)


quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(quaternions)
def test_every_rotation_passes_even_rounded_and_no_other_matrix(quaternion):
    matrix = rotation(quaternion)
    checked(matrix)
    # Rounding to 3 decimals moves each entry by e <= 5e-4: |R^T R - 1| <= 2 sqrt(3) e + 3 e^2 < 2e-3, of 1e-2 allowed.
    checked(matrix.round(3))
    # A scale of 1 % moves the diagonal of R^T R by 2e-2, twice what is allowed.
    with pytest.raises(InputError, match="rigid"):
        checked(1.01 * matrix)
    with pytest.raises(InputError, match="mirrors"):
        checked(matrix * [1, 1, -1])


def test_long_lists_are_cut():
    assert some(["a"] * SHOWN) == "a, a, a"
    assert some(list(range(20))) == "0, 1, 2 and 17 more"
