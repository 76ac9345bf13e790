# SPDX-License-Identifier: Apache-2.0
"""Seconds to a first picture, and the reading of many photographs, at sizes that say nothing but that they are told."""

import json
import sys

import pytest

from nrfgs_lab.timing import first_sight, loading

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


def test_loading(tmp_path, monkeypatch):
    monkeypatch.setattr(
        loading, "WAYS", {name: loading.WAYS[name] for name in ("memory", "files, made", "files, found")}
    )
    loading.Loading(tmp_path / "record.json", photographs=12, size=(64, 48)).main()
    found = json.loads((tmp_path / "record.json").read_text())
    assert found["decoded_bytes"] == 12 * 64 * 48 * 3
    for way in found["ways"].values():
        assert way["photographs"] == 12 and way["seconds_to_read"] > 0 and way["peak_bytes"] > 0
