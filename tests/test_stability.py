# SPDX-License-Identifier: Apache-2.0
"""The catalogue of extremes: its checks hold, and its tests exist; the hard trainings are those of the record."""

import ast
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hard_trainings import SCENE, hard_trainings, run
from PIL import Image
from plyfile import PlyData
from stability_catalogue import CATALOGUE

from nrfgs_lab.scenes import write_scene

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("quantity", CATALOGUE, ids=lambda quantity: quantity.name)
def test_check_holds(quantity):
    assert quantity.check() is True


def test_every_test_that_is_named_exists():
    for file, name in {tuple(test.split("::")) for quantity in CATALOGUE for test in quantity.tests}:
        tree = ast.parse((ROOT / file).read_text())
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{file}::{name}"


def test_the_record_has_every_hard_training_and_all_ended_finite():
    runs = json.loads((ROOT / "results" / "stability.json").read_text())["records"]["trainings"]["runs"]
    assert set(runs) == {training.name for training in hard_trainings()}
    assert all(one["finite"] for seeds in runs.values() for one in seeds.values())


def test_data_sets_of_the_hard_trainings_differ_as_they_say(tmp_path):
    edits = {training.name: training.edit for training in hard_trainings()}
    scene = write_scene(SCENE, tmp_path / "plain")

    def edited(name):
        folder = shutil.copytree(scene, tmp_path / name.replace(" ", "_"))
        edits[name](folder)
        return folder, json.loads((folder / "transforms.json").read_text())

    folder, meta = edited("nrfgs, unit x 1000, auto-scaling on")
    plain = json.loads((scene / "transforms.json").read_text())
    before, after = (np.array([frame["transform_matrix"] for frame in each["frames"]]) for each in (plain, meta))
    before[:, :3, 3] *= 1000
    assert np.allclose(before, after)
    points = [PlyData.read(str(f / "sparse.ply"))["vertex"]["x"] for f in (scene, folder)]
    assert np.allclose(points[1], 1000 * points[0], rtol=1e-6)
    folder, _ = edited("white images")
    assert all((np.array(Image.open(path)) == 255).all() for path in (folder / "images").glob("*.png"))
    _, meta = edited("one image")
    assert len(meta["frames"]) == len(meta["train_filenames"]) == 1
    folder, meta = edited("two identical images")
    first, second = meta["frames"]
    assert first["transform_matrix"] == second["transform_matrix"]
    assert (folder / first["file_path"]).read_bytes() == (folder / second["file_path"]).read_bytes()


HARD = [training for training in hard_trainings() if training.method == "nrfgs"]


@pytest.mark.slow
@pytest.mark.parametrize("training", HARD, ids=lambda training: training.name)
def test_hard_trainings_end_finite(training, tmp_path):
    assert run(training, training.seeds[0], 200, tmp_path)["finite"]
