# SPDX-License-Identifier: Apache-2.0
"""Trainings that version 0.1.0 has saved load, evaluate, resume and export.

"whole" is a training of `nrfgs` with a tiny field; "reduced" one whose field was made smaller while it trained and of
whose splats every other one is diffuse. Both saw the procedural scene below for 12 steps, with paths relative to the
folder that they were started in. The numbers here are what version 0.1.0 gave.
"""

import importlib
import shutil
from pathlib import Path

import pytest
import yaml

import nrfgs_ns
from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.densification import build_densification
from nrfgs_ns.export.command import Compact, Ply
from nrfgs_ns.export.options import PlyOptions
from nrfgs_ns.export.ply import read_splats
from nrfgs_ns.trained.loading import load_model
from nrfgs_ns.training.run import evaluate
from nrfgs_ns.training.trainer import NrfgsTrainer

pytestmark = pytest.mark.usefixtures("no_cuda")

SAVED = Path(__file__).resolve().parent / "fixtures" / "saved_0_1_0"
PSNR = {"whole": 17.164342, "reduced": 15.896972}
SSIM = {"whole": 0.119617, "reduced": 0.121195}
BYTES = {"whole": 6496, "reduced": 4068}
PSNR_OF_PLY = {"whole": 17.28, "reduced": 16.26}
RESUMED = {"whole": 17.205226}
"""PSNR after three more steps."""


@pytest.fixture(scope="module")
def started_in(tmp_path_factory) -> Path:
    """The folder in which the trainings were started."""
    folder = tmp_path_factory.mktemp("saved")
    write_scene(SceneConfig(views=10, width=48, height=36, points=60, samples=1), folder / "scene")
    for name in PSNR:
        shutil.copytree(SAVED / name, folder / "outputs" / name / "nrfgs" / "before")
    return folder


@pytest.fixture(params=list(PSNR))
def saved(request, started_in, monkeypatch) -> tuple[str, Path]:
    """Name and config.yml of a training."""
    monkeypatch.chdir(started_in)
    return request.param, Path("outputs") / request.param / "nrfgs" / "before" / "config.yml"


def test_they_evaluate_as_they_did(saved, tmp_path):
    name, config = saved
    results = evaluate(config, tmp_path / "eval.json")
    assert results["psnr"] == pytest.approx(PSNR[name], abs=1e-3)
    assert results["ssim"] == pytest.approx(SSIM[name], abs=1e-4)
    assert (results["splats"], results["parameter_bytes"]) == (60, BYTES[name])


def test_they_export(saved, tmp_path):
    name, config = saved
    Ply(config, output=tmp_path / "splats.ply", report=tmp_path / "ply.json", options=PlyOptions(steps=0)).main()
    assert len(read_splats(tmp_path / "splats.ply").means) == 60
    report = yaml.safe_load((tmp_path / "ply.json").read_text())
    assert report["psnr_file"] == pytest.approx(PSNR_OF_PLY[name], abs=0.02)
    Compact(config, output=tmp_path / "splats.nrf", report=tmp_path / "compact.json").main()
    report = yaml.safe_load((tmp_path / "compact.json").read_text())
    assert report["written"] == 60 and report["loss_db"] < 0.2


def test_what_was_left_of_a_field_is_there(started_in, monkeypatch):
    monkeypatch.chdir(started_in)
    model = load_model(Path("outputs/reduced/nrfgs/before/config.yml"), "test").model
    assert model.head.high is None and model.head.config.latent_dim == 1
    assert not model.head.config.use_distance and not model.head.config.opacity_residual
    assert model.densification.state[DIFFUSE].tolist() == [False, True] * 30


def test_they_go_on(saved, tmp_path):
    name, path = saved
    config = yaml.load(path.read_text(), Loader=yaml.Loader)
    config.load_dir, config.max_num_iterations, config.output_dir = path.parent / "nerfstudio_models", 15, tmp_path
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    assert type(trainer) is NrfgsTrainer
    trainer.setup()
    trainer.train()
    resumed = config.get_base_dir() / "config.yml"
    results = evaluate(resumed, tmp_path / "eval.json")
    if name in RESUMED:
        assert results["psnr"] == pytest.approx(RESUMED[name], abs=0.01)
    assert results["psnr"] > PSNR[name] and results["parameter_bytes"] == BYTES[name]


def test_a_strategy_that_is_no_more_is_the_one_that_it_was_made_of(started_in, monkeypatch):
    monkeypatch.chdir(started_in)
    path = Path("outputs") / "whole" / "nrfgs" / "before" / "config.yml"
    text = path.read_text()
    old = "consistent: !!python/object:nrfgs_ns.densification.consistent.ConsistentDensification\n      views: 10\n"
    assert "    densification: splatfacto\n" in text
    model = yaml.load(
        text.replace("    densification: splatfacto\n", f"    {old}    densification: consistent\n"), Loader=yaml.Loader
    ).pipeline.model
    assert model.densification == "splatfacto"
    assert build_densification(model, 8).name == "splatfacto"


@pytest.mark.parametrize("name", nrfgs_ns.MOVED)
def test_every_old_name_imports(name):
    """As the module that it is now, whose classes are one and the same."""
    now = nrfgs_ns.MOVED[name]
    module = importlib.import_module(name)
    assert now is None or module is importlib.import_module(now)
