# SPDX-License-Identifier: Apache-2.0
"""Broken data sets: each must be refused with a message that names the culprit and the fix."""

from pathlib import Path

import numpy as np
import pytest
from broken_captures import FILES, META, everywhere
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nrfgs_ns.data.checks import check_poses
from nrfgs_ns.errors import InputError


@pytest.mark.parametrize("change, words", (META | FILES).values(), ids=(META | FILES).keys())
def test_refused(capture, change, words):
    change(capture)
    with pytest.raises(InputError) as error:
        capture.parse()
    absent = [word for word in words.split() if word not in str(error.value)]
    assert not absent, f"{absent} not in: {error.value}"


def test_data_that_is_not_there(tmp_path, capture):
    with pytest.raises(InputError, match=r"nowhere: no such file or folder.*--data"):
        capture.parse(data=tmp_path / "nowhere")
    (tmp_path / "bare").mkdir()
    with pytest.raises(InputError, match=r"transforms.json is missing.*nrfgs prepare"):
        capture.parse(data=tmp_path / "bare")


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
