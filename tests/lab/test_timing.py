# SPDX-License-Identifier: Apache-2.0
"""The measurement of the first picture, on a tiny scene."""

import json
import sys

import pytest

from nrfgs_lab.timing import first_sight

pytestmark = pytest.mark.slow


def test_first_sight(tiny_scene, tmp_path, monkeypatch):
    record = tmp_path / "record.json"
    words = [
        "nrfgs",
        "--data",
        tiny_scene,
        "--output-dir",
        tmp_path,
        "--vis",
        "tensorboard",
        "--max-num-iterations",
        40,
    ]
    monkeypatch.setattr(sys, "argv", list(map(str, ["", record, "--every", 0, "--targets", 5, 99, "--", *words])))
    first_sight.main()
    found = json.loads(record.read_text())
    stages = found["stages"]
    assert list(stages) == sorted(stages, key=stages.get) and {"imported", "images read", "set up", "step 0"} <= set(
        stages
    )
    assert found["reached"].keys() == {"5"} and found["reached"]["5"]["seconds"] >= stages["step 0"]
    assert [step for _, step, _ in found["curve"]] == list(range(1, 41))
    assert found["peak_host_bytes"] > 1e8
