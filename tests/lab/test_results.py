# SPDX-License-Identifier: Apache-2.0
"""A study in one file is the study's folder, to seven digits; FLIP as its authors compute it."""

import json
import sys

import numpy as np
import pytest

from nrfgs_lab.flip import flip
from nrfgs_lab.results import lines, pack, unpack
from nrfgs_ns.errors import InputError


def test_a_folder_comes_back(tmp_path):
    folder = tmp_path / "out"
    (folder / "runs").mkdir(parents=True)
    image = [{"image": "a.png", "psnr": 30.123456789}]
    run = {"eval": {"psnr": 1 / 3, "per_image": image}, "measured": {"test": {"per_image": image}}, "splats": 123456789}
    run["train"] = {"splats": [[step, 10 * step] for step in range(0, 1101, 100)] + [[1149, 7]]}
    (folder / "runs" / "one.json").write_text(json.dumps(run))
    (folder / "table.md").write_text("| a |\n|---|\n")
    (folder / "splats.png").write_bytes(b"no text")
    pack(folder, tmp_path / "study.json")
    assert json.loads((tmp_path / "study.json").read_text())["study"] == "study"
    unpack(tmp_path / "study.json", tmp_path / "again")
    assert {path.name for path in (tmp_path / "again").rglob("*.*")} == {"one.json", "table.md"}
    assert (tmp_path / "again" / "table.md").read_text() == "| a |\n|---|\n"
    found = json.loads((tmp_path / "again" / "runs" / "one.json").read_text())
    assert found["train"]["splats"] == [[0, 0], [500, 5000], [1000, 10000], [1149, 7]]
    assert found["eval"] == {"psnr": 0.3333333} and found["splats"] == 123456789
    assert found["measured"]["test"]["per_image"] == [{"image": "a.png", "psnr": 30.12346}]


def test_lines_of_trials_join_a_study(tmp_path):
    one = {"name": "a", "scene": "s", "seed": 42, "psnr": 30.123456789}
    (tmp_path / "out.jsonl").write_text(json.dumps(one) + "\n" + json.dumps({**one, "seed": 43}) + "\n")
    for _ in range(2):
        lines(tmp_path / "out.jsonl", tmp_path / "study.json")
    found = json.loads((tmp_path / "study.json").read_text())["records"]
    assert list(found) == ["a/s-42", "a/s-43"] and found["a/s-42"]["psnr"] == 30.12346


def test_without_the_package_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(InputError, match="pip install flip-evaluator"):
        flip(np.zeros((8, 8, 3)), np.zeros((8, 8, 3)))


def test_equal_is_zero_different_is_more_and_outside_a_mask_nothing_counts():
    pytest.importorskip("flip_evaluator")
    truth = np.random.default_rng(0).random((40, 50, 3))
    worse = np.clip(truth + 0.2, 0, 1)
    assert flip(truth, truth) == 0.0
    assert 0 < flip(np.clip(truth + 0.05, 0, 1), truth) < flip(worse, truth) <= 1
    left = np.zeros((40, 50), dtype=bool)
    left[:, :25] = True
    half = np.where(left[..., None], truth, worse)
    assert flip(half, truth, left) == 0.0 < flip(half, truth, ~left)
    assert flip(half, truth, np.zeros_like(left)) is None
