# SPDX-License-Identifier: Apache-2.0
"""A trained model is found from another folder, moved with its data, beside foreign files, with a damaged file."""

import shutil

import pytest
import torch
from short_trainings import command_line, models_of, trained

from nrfgs_ns.errors import InputError
from nrfgs_ns.export.loading import load_training
from nrfgs_ns.training.checkpoint_files import find

pytestmark = pytest.mark.usefixtures("no_cuda")


@pytest.fixture
def project(tiny_scene, tmp_path, monkeypatch):
    """A folder with a data set and, trained on it by relative paths, a model of 3 steps in two checkpoints."""
    (tmp_path / "project").mkdir()
    shutil.copytree(tiny_scene, tmp_path / "project" / "data")
    monkeypatch.chdir(tmp_path / "project")
    config = trained(command_line("nrfgs", "data", "outputs", 3, {"--steps-per-save": 1}))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "project" / config


def test_a_project_is_read_from_another_folder_and_after_a_move(project, tmp_path):
    assert load_training(project, "test").step == 2
    shutil.move(tmp_path / "project", tmp_path / "moved")
    config = tmp_path / "moved" / project.relative_to(tmp_path / "project")
    (models_of(config) / "notes.txt").write_text("mine")
    found = load_training(config, "test")
    assert found.step == 2 and found.checkpoint.parent == models_of(config)
    assert found.pipeline.datamanager.get_datapath() == tmp_path / "moved" / "data"

    newest, before = find(models_of(config)).values()
    whole = torch.load(before, weights_only=True)["pipeline"]["_model.gauss_params.means"]
    flipped = bytearray(newest.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    newest.write_bytes(flipped)
    found = load_training(config, "test")
    assert found.step == 1 and torch.equal(found.pipeline.model.means, whole)

    shutil.rmtree(tmp_path / "moved" / "data")
    with pytest.raises(
        InputError, match=r"its data set is not at .*/project/data, nor at .*/moved/data\. Put it there"
    ):
        load_training(config, "test")
