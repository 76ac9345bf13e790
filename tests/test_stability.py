# SPDX-License-Identifier: Apache-2.0
"""The catalogue of extremes: its checks hold, and its tests exist; the hard trainings are those of the record."""

import ast
import json
from pathlib import Path

import pytest
from hard_trainings import hard_trainings, run
from stability_catalogue import CATALOGUE

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


HARD = [training for training in hard_trainings() if training.method == "nrfgs"]


@pytest.mark.slow
@pytest.mark.parametrize("training", HARD, ids=lambda training: training.name)
def test_hard_trainings_end_finite(training, tmp_path):
    assert run(training, training.seeds[0], 200, tmp_path)["finite"]
