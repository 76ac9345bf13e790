# SPDX-License-Identifier: Apache-2.0
"""A second training, with which the first agrees between the cameras."""

from random import Random
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from short_trainings import REFINING, assert_same_training, checkpoint_of, command_line, models_of, set_up, trained
from torch.testing import assert_close

from nrfgs_ns.errors import InputError
from nrfgs_ns.image.ssim import photometric_loss
from nrfgs_ns.training import twin
from nrfgs_ns.training.checkpoint_files import read_latest
from nrfgs_ns.training.guard import TrainingStopped
from nrfgs_ns.training.pipeline import descend
from nrfgs_ns.training.twin import picture, pull

BESIDE, ALONE = {"--pipeline.model.twin": "on", **REFINING}, {"--pipeline.model.twin": "off"}


@pytest.fixture(autouse=True)
def from_the_start(monkeypatch):
    monkeypatch.setattr(twin, "START", 0)


def ready(scene, out, *options):
    trainer = set_up(command_line("nrfgs", scene, out, 10, BESIDE, *options))
    trainer.twin.begin()
    return trainer


@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-harmonics", "nrfgs-deferred"])
def test_a_training_with_a_twin_goes_on_from_its_checkpoint(method, tiny_scene, tmp_path, no_cuda):
    whole = trained(command_line(method, tiny_scene, tmp_path / "whole", 14, BESIDE, {"--steps-per-save": 7}))
    half = read_latest(models_of(whole), 7)[1]
    more = {"--load-dir": models_of(whole), "--load-step": 7}
    rest = trained(command_line(method, tiny_scene, tmp_path, 14, BESIDE, more))
    both = [checkpoint_of(config) for config in (whole, rest)]
    assert_same_training(*both)
    twins = [{"step": 0, "pipeline": each["training"]["twin"]["model"], **each["training"]["twin"]} for each in both]
    assert_same_training(*twins)
    assert len(half["training"]["twin"]["model"]["gauss_params.means"]) != len(twins[0]["model"]["gauss_params.means"])
    assert not both[0]["pipeline"]["_model.gauss_params.means"].equal(twins[0]["model"]["gauss_params.means"])


def test_a_checkpoint_without_a_twin_goes_on_alone(tiny_scene, tmp_path, no_cuda, capsys):
    alone = trained(command_line("nrfgs", tiny_scene, tmp_path / "alone", 4, BESIDE, ALONE))
    assert "twin" not in checkpoint_of(alone)["training"]
    trainer = set_up(command_line("nrfgs", tiny_scene, tmp_path / "more", 6, BESIDE, {"--load-dir": models_of(alone)}))
    assert trainer.twin is None and trainer.pipeline.model.densification.trainings == 1
    assert "goes on without one" in capsys.readouterr().out
    both = trained(command_line("nrfgs", tiny_scene, tmp_path / "both", 4, BESIDE))
    set_up(command_line("nrfgs", tiny_scene, tmp_path, 6, BESIDE, {"--load-dir": models_of(both), **ALONE}))
    assert "The training has no twin" in capsys.readouterr().out


def test_a_checkpoint_is_of_a_twin_of_finite_numbers(tiny_scene, tmp_path, no_cuda):
    trainer = ready(tiny_scene, tmp_path)
    trainer.twin.pipeline.model.gauss_params["means"].data[3] = torch.nan
    with pytest.raises(TrainingStopped, match="means has NaN"):
        trainer.save_checkpoint(4)
    assert read_latest(trainer.checkpoint_dir)[1]["training"]["twin"]["model"]["gauss_params.means"].isfinite().all()


@pytest.mark.parametrize("views, device, changed, every", [
    (9, "cuda", {}, 2), (24, "cuda", {}, 3), (50, "cuda", {}, 5), (51, "cuda", {}, None), (9, "cpu", {}, None),
    (9, "cuda", {"time_budget": 1.0}, None), (9, "cuda", {"schedule_steps": 3000}, None),
    (9, "cuda", {"twin": "off"}, None), (10_000, "cpu", {"twin": "on"}, twin.RAREST),
])  # fmt: skip
def test_few_views_on_a_gpu_have_a_twin(views, device, changed, every, monkeypatch):
    monkeypatch.setattr(twin, "START", 6000)
    monkeypatch.setattr(twin, "Twin", lambda trainer, every: every)
    still = SimpleNamespace(config=SimpleNamespace(mode="off"))
    options = SimpleNamespace(twin=changed.pop("twin", "auto"))
    model = SimpleNamespace(num_views=views, device=torch.device(device), camera_optimizer=still, config=options)
    config = SimpleNamespace(**{"time_budget": None, "schedule_steps": 30_000, "max_num_iterations": 10_000, **changed})
    trainer = SimpleNamespace(pipeline=SimpleNamespace(model=model), config=config)
    assert twin.twin_of(trainer) == every
    model.config.twin, config.time_budget, config.schedule_steps = "on", None, 3000
    with pytest.raises(InputError, match="from step 6000"):
        twin.twin_of(trainer)


def test_views_lie_between_neighbouring_cameras(tiny_scene, tmp_path, no_cuda, monkeypatch):
    monkeypatch.setattr(twin, "JITTER", 0.0)
    trainer = ready(tiny_scene, tmp_path)
    between, cameras = trainer.twin.between, trainer.pipeline.datamanager.train_dataset.cameras
    for seed in range(20):
        view = between.draw(Random(seed))
        assert view.camera_to_worlds.equal(between.draw(Random(seed)).camera_to_worlds)
        pose, index = view.camera_to_worlds[0], view.metadata["cam_idx"]
        assert_close(pose[:, :3] @ pose[:, :3].T, torch.eye(3), rtol=0, atol=1e-5)
        assert (view.fx, view.width) == (cameras.fx[index], cameras.width[index])
        ends = cameras.camera_to_worlds[[index, *between.neighbours[index]], :, 3]
        to_one, to_others = (pose[:, 3] - ends[0]).norm(), (pose[:, 3] - ends[1:]).norm(dim=1)
        assert ((ends[1:] - ends[0]).norm(dim=1) - to_one - to_others).abs().min() < 1e-5  # on a line between two
    poses = torch.eye(4)[:3].repeat(40, 1, 1)
    poses[:, 0, 3] = 50_000 + torch.arange(40)  # far from the origin
    assert sorted(twin.Between(Cameras(poses, 1.0, 1.0, 1.0, 1.0)).neighbours[7]) == [5, 6, 8, 9]


def test_with_exposures_pictures_and_what_learns_from_them_are_over_black(tiny_scene, tmp_path, no_cuda):
    trainer = ready(tiny_scene, tmp_path, {"--pipeline.model.photographs": "on", "--pipeline.model.view-noise": 0})
    model, view = trainer.pipeline.model, trainer.twin.between.draw(Random(0))
    assert_close(picture(trainer, view, 0) / 255, model.get_outputs(view)["rgb"], rtol=0, atol=0.5001 / 255)


def test_a_pull_is_the_gradient_of_the_loss_against_the_others_picture(tiny_scene, tmp_path, no_cuda):
    trainer = ready(tiny_scene, tmp_path)
    model, view = trainer.pipeline.model, trainer.twin.between.draw(Random(0))
    seen = picture(trainer.twin, view, 4)
    assert seen.dtype == torch.uint8 and seen.shape[-1] == 4
    model.view_noise.sigma, model.background_color = 0.0, torch.zeros(3)
    model.config.background_color = "black"
    gradients = pull(trainer, view, seen, 4)
    assert model.gauss_params["latents"] not in gradients and model.gauss_params["means"] in gradients
    truth = seen[..., :3] / 255 * (seen[..., 3:] / 255)

    def loss(features):
        model.gauss_params["features_dc"].data = features
        return photometric_loss(model.get_outputs(view)["rgb"], truth, model.config.ssim_lambda).item()

    parameter = model.gauss_params["features_dc"]
    start, gradient = parameter.data.clone(), gradients[parameter]
    step = 1e-3 * gradient / gradient.norm()
    assert (loss(start + step) - loss(start - step)) / 2e-3 == pytest.approx(gradient.norm().item(), rel=0.05)


def test_densification_looks_at_photographs_alone(tiny_scene, tmp_path, no_cuda):
    """A pull leaves the step's gradients on the screen, its image to the guard and its residuals as without it."""
    trainer = ready(tiny_scene, tmp_path, {"--pipeline.model.robust-loss": 0.1})
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    model.schedule_at(500)  # where pixels are trimmed
    start = {name: value.detach().clone() for name, value in model.named_parameters()}
    seen = []
    for pulls in (False, True):
        pipeline.datamanager.train_unseen_cameras = [0]
        view = trainer.twin.between.draw(Random(0))
        more = pull(trainer, view, picture(trainer.twin, view, 0), 0) if pulls else {}
        torch.manual_seed(1)
        descend(trainer, 0, more)
        info, remembered = model.info, model.trimming.histogram.clone()
        seen.append((info["means2d"].grad, model.watched["the rendered image"], info["gaussian_ids"], remembered))
        model.trimming.histogram.zero_()
        for name, value in model.named_parameters():
            value.data.copy_(start[name])
    assert_close(seen[1], seen[0])


@pytest.mark.gpu
@pytest.mark.parametrize("photographs", ["off", "on"])
def test_pictures_and_pulls_are_the_same_recorded(photographs, tiny_scene, tmp_path):
    options = {"--pipeline.model.appearance.precision": "fp32", "--pipeline.model.photographs": photographs}
    trainer = ready(tiny_scene, tmp_path, options)
    model, twin = trainer.pipeline.model, trainer.twin
    for each in (model, twin.pipeline.model):  # turning a round splat changes nothing but the last bits
        each.gauss_params["scales"].data += 0.5 * torch.randn_like(each.gauss_params["scales"])
        if each.photograph is not None:
            each.photograph.shots.data.normal_(0.0, 0.1)
    pictures, pulls = [], []
    for attempt in range(4):  # the first is eager, the second recorded, the third a replay
        trainer.graphs._given_up = twin.graphs._given_up = attempt == 3
        for each, optimizers in ((model, trainer.optimizers), (twin.pipeline.model, twin.optimizers)):
            each.step_cb(optimizers, 20)
        view = twin.between.draw(Random(0))
        pictures.append(picture(twin, view, 20))
        picture(trainer, twin.between.draw(Random(1)), 20)
        torch.manual_seed(7)
        pulls.append(pull(trainer, view, pictures[0], 20))
    assert [len(each.graphs._graphs) for each in (trainer, twin)] == [2, 1]
    for other in pictures[:3]:  # a rounding moves few pixels to the next level
        assert (other.int() - pictures[3].int()).abs().max() <= 1 and (other != pictures[3]).float().mean() < 1e-3
    for name, parameter in model.named_parameters():
        if parameter in pulls[3]:
            expected = pulls[3][parameter]
            for other in pulls[:3]:
                assert (other[parameter] - expected).norm() <= 1e-4 * expected.norm() + 1e-9, name
