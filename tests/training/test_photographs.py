# SPDX-License-Identifier: Apache-2.0
"""When photographs' exposure is learnt, what a training makes of it, and what comes out: on a scene of known stops."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from exposures import exposed
from PIL import ExifTags, Image
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained, untrained

from nrfgs_ns.errors import InputError
from nrfgs_ns.image.overlap import Pairs, estimate
from nrfgs_ns.image.photograph import BASIS
from nrfgs_ns.trained.loading import load_model
from nrfgs_ns.training.photographs import exif_of, exposure, exposures, they_differ

NAN = math.nan


def pairs_with(shifts) -> Pairs:
    """Pairs of photographs 0 and 1, 1 and 2, ... whose exposure differs by these stops."""
    count = len(shifts)
    shift = torch.zeros(count, 3)
    shift[:, 0] = torch.tensor(shifts)
    return Pairs(torch.arange(count), torch.arange(count) + 1, shift, torch.full((count, 3), 0.05))


SAME, DIFFERENT = pairs_with([0.01] * 10), pairs_with([0.5, -0.8, 0.2, 0.5, -0.4, -0.3, 0.7, 0.1, -0.9, 0.4])
CENTERS = torch.arange(11.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])


@pytest.mark.parametrize(("pairs", "known", "wanted"), [
    (SAME, [NAN] * 11, False), (DIFFERENT, [NAN] * 11, True),
    (pairs_with([0.5, -0.5, 0.5]), [NAN] * 11, False), (pairs_with([]), [0.0, 1.5] + [NAN] * 9, True),
    (SAME, [0.3] + [NAN] * 10, False), (SAME, [0.3, 0.5] * 5 + [0.3], False),
    # The light changed, and the camera followed it.
    (SAME, [0.0, 0.9] * 5 + [0.0], False), (DIFFERENT, [0.0, 0.7] * 5 + [0.0], True),
])  # fmt: skip
def test_the_evidence_decides(pairs, known, wanted):
    assert they_differ(pairs, torch.tensor(known), estimate(pairs, torch.full((11,), NAN), CENTERS)) == wanted


def test_exposure_in_stops_of_exif_from_the_data_set_or_else_from_the_file(tmp_path):
    exif = {"exposure_time": 0.01, "iso": 100, "f_number": 4.0}
    assert exposure({**exif, "exposure_time": 0.02, "iso": 200}) - exposure(exif) == pytest.approx(2.0)
    assert exposure({**exif, "f_number": 2.0}) - exposure(exif) == pytest.approx(2.0)
    assert math.isnan(exposure({"f_number": 2.0, "iso": 100})) and math.isnan(exposure({}))
    assert exposures([exif, {}, exif, {"exposure_time": 0.01, "iso": 100}]).isnan().tolist() == [0, 1, 0, 1]
    photo, exif = tmp_path / "a.jpg", Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ExposureTime] = 0.25
    Image.new("RGB", (8, 8)).save(photo, exif=exif)
    assert exif_of([photo, tmp_path / "b.jpg"], [{}, {"iso": 50}]) == [{"exposure_time": 0.25}, {"iso": 50}]


@pytest.fixture(scope="module")
def exposed_scene(tmp_path_factory):
    """A procedural data set of 24 photographs, 128 x 96, with known stops, and those stops by name."""
    from nrfgs_lab.scenes import SceneConfig, write_scene

    config = SceneConfig(views=24, width=128, height=96, points=4000, samples=1)
    scene = write_scene(config, tmp_path_factory.mktemp("data") / "exposed")
    meta = json.loads((scene / "transforms.json").read_text())
    random, stops = np.random.default_rng(0), {}
    for frame in meta["frames"]:
        path = scene / frame["file_path"]
        drawn = random.uniform(-1, 1) + 0.1 * random.standard_normal(3)
        with Image.open(path) as image:
            values = np.asarray(image.convert("RGB")) / 255.0
        light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
        light = np.clip(light * 2.0**drawn, 0.0, 1.0)
        values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        Image.fromarray(np.rint(255.0 * values).astype(np.uint8)).save(path)
        stops[path.name] = drawn
    return scene, stops


QUICK = {
    "--pipeline.model.num-downscales": 1,
    "--pipeline.model.background-color": "black",
    "--pipeline.model.warmup-steps": 0,
    "--pipeline.model.densification": "splatfacto,refine_every=1000",
}
TWICE = {"--steps-per-save": 2}


@pytest.fixture(scope="module")
def finished(exposed_scene, tmp_path_factory):
    """config.yml of a training of four steps with exposures of the photographs; with the checkpoint of step 2."""
    return trained(command_line("nrfgs-sh", exposed_scene[0], tmp_path_factory.mktemp("whole"), 4, QUICK, TWICE))


def test_known_exposures_are_found(exposed_scene, finished):
    _, stops = exposed_scene
    state = checkpoint_of(finished)["pipeline"]
    names = state["_model.photograph._extra_state"]["names"]
    learnt = state["_model.photograph.shots"][:, 0].numpy()
    truth = np.array([np.mean(stops[name]) for name in names])
    assert np.corrcoef(learnt, truth)[0, 1] > 0.95
    assert np.abs(learnt - (truth - truth.mean())).mean() < 0.15
    assert abs(learnt.mean()) < 1e-6


def assert_it_goes_on(config, scene, out, *more: dict) -> None:
    """From step 2 to the bit."""
    load = {"--load-dir": models_of(config), "--load-step": 2}
    rest = trained(command_line("nrfgs-sh", scene, out, 4, QUICK, load, *more))
    assert_same_training(checkpoint_of(config), checkpoint_of(rest), rtol=0, atol=0)


def test_resumed_is_the_unbroken_one(exposed_scene, finished, tmp_path, capsys):
    assert_it_goes_on(finished, exposed_scene[0], tmp_path)
    said = " ".join(capsys.readouterr().out.split())
    assert "Photographs: exposure and white balance learnt, since the photographs differ" in said


def test_a_capture_that_needs_none_pays_nothing(tiny_scene, tmp_path, monkeypatch, capsys):
    config = trained(command_line("nrfgs-sh", tiny_scene, tmp_path, 2, QUICK))
    checkpoint = checkpoint_of(config)
    assert not any("photograph" in name for name in checkpoint["pipeline"])
    assert "photograph" not in checkpoint["optimizers"]
    more = {"--load-dir": models_of(config), "--pipeline.model.photographs": "on"}
    with pytest.raises(InputError, match="pipeline.model.photographs off"):
        trained(command_line("nrfgs-sh", tiny_scene, tmp_path / "on", 2, QUICK, more))
    monkeypatch.setenv("NRFGS_LOOK", "view_001.png")
    load_model(config, "test")
    assert "learnt no photograph's exposure" in " ".join(capsys.readouterr().out.split())


def test_renderings_have_the_mean_look_or_a_photographs(exposed_scene, finished, monkeypatch):
    from nerfstudio.utils.eval_utils import eval_setup

    _, stops = exposed_scene
    _, pipeline, _, _ = eval_setup(finished)
    model = pipeline.model
    camera = pipeline.datamanager.train_dataset.cameras[:1]
    mean = model.get_outputs_for_camera(camera)["rgb"]
    monkeypatch.setenv("NRFGS_LOOK", max(model.photograph.names, key=lambda name: stops[name].mean()))
    assert (model.get_outputs_for_camera(camera)["rgb"] - mean).mean() > 0.02
    monkeypatch.setenv("NRFGS_LOOK", "nobody.jpg")
    with pytest.raises(InputError, match="nobody.jpg"):  # a training says so before its first step
        model.learn_photographs(model.photograph)


def test_what_is_behind_a_cut_out_photograph_is_exposed_with_it(tiny_scene, tmp_path):
    model = untrained(tiny_scene, tmp_path, "nrfgs-sh", "--pipeline.model.photographs", "on").model.train()
    with torch.no_grad():
        model.photograph.shots[3] = torch.tensor([-1.0, 0.2, 0.1])
    transparent = {"image": torch.zeros(6, 8, 4, dtype=torch.uint8), "image_idx": 3}
    grey = torch.full((3,), 0.5)
    model.config.num_downscales = 0
    truth = model.truth_of(transparent, grey)
    torch.testing.assert_close(truth, exposed(grey.expand(6, 8, 3), model.photograph.shots[3] @ torch.tensor(BASIS)))
    assert torch.equal(model.eval().truth_of(transparent, grey), grey.expand(6, 8, 3))


def test_robust_loss_trims_and_goes_on(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("nrfgs_ns.image.robust.FIRST_STEP", 1)
    robust = {"--pipeline.model.robust-loss": 0.1}
    whole = trained(command_line("nrfgs-sh", tiny_scene, tmp_path / "whole", 4, QUICK, TWICE, robust))
    assert checkpoint_of(whole)["pipeline"]["_model.trimming.histogram"].sum() > 0
    assert_it_goes_on(whole, tiny_scene, tmp_path / "rest", robust)


def test_photographs_of_one_name_are_told_apart_by_their_folders(tiny_scene, tmp_path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    listed = (scene / "transforms.json").read_text()
    for folder, name in (("left", "images/view_001.png"), ("right", "images/view_002.png")):
        (scene / folder).mkdir()
        (scene / name).rename(scene / folder / "1.png")
        listed = listed.replace(name, f"{folder}/1.png")
    (scene / "transforms.json").write_text(listed)
    model = untrained(scene, tmp_path, "nrfgs-sh", "--pipeline.model.photographs", "on").model
    assert {"left/1.png", "right/1.png", "images/view_003.png"} < set(model.photograph.names)
