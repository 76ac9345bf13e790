# SPDX-License-Identifier: Apache-2.0
"""A second training, with which the first agrees between the cameras."""

from random import Random

import pytest
import torch
from short_trainings import REFINING, assert_same_training, checkpoint_of, command_line, models_of, set_up, trained
from torch.testing import assert_close

from nrfgs_ns.errors import InputError
from nrfgs_ns.image.ssim import photometric_loss
from nrfgs_ns.training import twin
from nrfgs_ns.training.checkpoint_files import read_latest
from nrfgs_ns.training.twin import descend, picture, pull, steps_between

BESIDE = {"--pipeline.model.twin": "on", **REFINING}


def ready(scene, out, *options):
    trainer = set_up(command_line("nrfgs", scene, out, 10, BESIDE, *options))
    trainer.twin.begin()
    return trainer


@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-harmonics"])
def test_a_training_with_a_twin_goes_on_from_its_checkpoint(method, tiny_scene, tmp_path, no_cuda):
    whole = trained(command_line(method, tiny_scene, tmp_path / "whole", 14, BESIDE, {"--steps-per-save": 7}))
    half = read_latest(models_of(whole), 7)[1]
    rest = trained(
        command_line(method, tiny_scene, tmp_path, 14, BESIDE, {"--load-dir": models_of(whole), "--load-step": 7})
    )
    both = [checkpoint_of(config) for config in (whole, rest)]
    assert_same_training(*both)
    twins = [{"step": 0, "pipeline": each["training"]["twin"]["model"], **each["training"]["twin"]} for each in both]
    assert_same_training(*twins)
    assert len(half["training"]["twin"]["model"]["gauss_params.means"]) != len(twins[0]["model"]["gauss_params.means"])
    means = both[0]["pipeline"]["_model.gauss_params.means"]
    assert (
        means.shape != twins[0]["model"]["gauss_params.means"].shape
        or means.ne(twins[0]["model"]["gauss_params.means"]).any()
    )


def test_a_checkpoint_without_a_twin_goes_on_alone(tiny_scene, tmp_path, no_cuda):
    alone = trained(command_line("nrfgs", tiny_scene, tmp_path / "alone", 4, BESIDE, {"--pipeline.model.twin": "off"}))
    assert "twin" not in checkpoint_of(alone)["training"]
    more = command_line("nrfgs", tiny_scene, tmp_path / "more", 6, BESIDE, {"--load-dir": models_of(alone)})
    assert "twin" not in checkpoint_of(trained(more))["training"]


def test_few_views_on_a_gpu_have_a_twin(tiny_scene, tmp_path, no_cuda, capsys):
    every = [steps_between(views) for views in (3, 24, 40, 50, 60, 10_000)]
    assert every == sorted(every[:4]) + [0, 0] and every[0] == twin.EVERY
    assert set_up(command_line("nrfgs", tiny_scene, tmp_path / "auto", 1)).twin is None  # on a CPU
    assert "trained twice" not in capsys.readouterr().out
    ready(tiny_scene, tmp_path / "on")
    assert "trained twice" in capsys.readouterr().out


def test_views_lie_between_neighbouring_cameras(tiny_scene, tmp_path, no_cuda):
    between = ready(tiny_scene, tmp_path).twin.between
    cameras = between.cameras.camera_to_worlds
    assert between.draw(Random(1)).camera_to_worlds.equal(between.draw(Random(1)).camera_to_worlds)
    for seed in range(20):
        view = between.draw(Random(seed))
        pose = view.camera_to_worlds[0]
        assert_close(pose[:, :3] @ pose[:, :3].T, torch.eye(3), rtol=0, atol=1e-5)
        index = view.metadata["cam_idx"]
        assert (view.fx, view.width) == (between.cameras.fx[index], between.cameras.width[index])
        others = cameras[between.neighbours[index]]
        ends = torch.stack([cameras[index].expand_as(others), others], dim=1)
        line = ends[:, 1, :, 3] - ends[:, 0, :, 3]
        share = (((pose[:, 3] - ends[:, 0, :, 3]) * line).sum(-1) / line.square().sum(-1)).clamp(0, 1)
        off = (ends[:, 0, :, 3] + share[:, None] * line - pose[:, 3]).norm(dim=-1).min()
        assert off < 5 * 3**0.5 * twin.JITTER * between.spacing


def test_a_pull_is_the_gradient_of_the_loss_against_the_others_picture(tiny_scene, tmp_path, no_cuda):
    trainer = ready(tiny_scene, tmp_path)
    model, other = trainer.pipeline.model, trainer.twin.pipeline.model
    view = trainer.twin.between.draw(Random(0))
    seen = picture(other, view)
    assert seen.dtype == torch.uint8 and seen.shape[-1] == 4
    model.view_noise.sigma, model.background_color = 0.0, torch.zeros(3)
    model.config.background_color = "black"
    gradients = pull(trainer, view, seen, 4)
    truth = seen[..., :3] / 255 * (seen[..., 3:] / 255)

    def loss(features):
        model.gauss_params["features_dc"].data = features
        rgb = model.get_outputs(view)["rgb"]
        return photometric_loss(rgb, truth, model.config.ssim_lambda).item()

    parameter = model.gauss_params["features_dc"]
    start, gradient = parameter.data.clone(), gradients[parameter]
    step = 1e-3 * gradient / gradient.norm()
    slope = (loss(start + step) - loss(start - step)) / (2e-3)
    assert slope == pytest.approx(gradient.norm().item(), rel=0.05)


def test_densification_looks_at_photographs_alone(tiny_scene, tmp_path, no_cuda):
    """A pull leaves the step's own gradients on the screen, and its image to the guard, as they are without it."""
    trainer = ready(tiny_scene, tmp_path)
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    start = {name: value.detach().clone() for name, value in model.named_parameters()}
    seen = []
    for pulls in (False, True):
        pipeline.datamanager.train_unseen_cameras = [0]
        view = trainer.twin.between.draw(Random(0))
        more = pull(trainer, view, picture(trainer.twin.pipeline.model, view), 0) if pulls else {}
        torch.manual_seed(1)
        descend(trainer, 0, more)
        seen.append(
            (model.info["means2d"].grad.clone(), model.watched["the rendered image"], model.info["gaussian_ids"])
        )
        for name, value in model.named_parameters():
            value.data.copy_(start[name])
    assert_close(seen[1], seen[0])


def test_one_place_has_nothing_between(tiny_scene, tmp_path, no_cuda, monkeypatch):
    monkeypatch.setattr(twin, "camera_spacing", lambda centers: 0.0)
    with pytest.raises(InputError, match="twin is on, but all cameras stand at one place"):
        ready(tiny_scene, tmp_path)


@pytest.mark.gpu
def test_a_pull_is_the_same_recorded(tiny_scene, tmp_path):
    exact = {"--pipeline.model.appearance.precision": "fp32", "--pipeline.model.twin": "auto"}
    trainer = ready(tiny_scene, tmp_path, exact)
    model = trainer.pipeline.model
    results = []
    for attempt in range(4):  # the first is eager, the second recorded, the third a replay
        trainer.graphs._given_up = attempt == 3
        model.step_cb(trainer.optimizers, 20)
        view = trainer.twin.between.draw(Random(0))
        seen = picture(trainer.twin.pipeline.model, view)
        torch.manual_seed(7)
        results.append(pull(trainer, view, seen, 20))
    assert len(trainer.graphs._graphs) == 1
    for name, parameter in model.named_parameters():
        if parameter in results[3]:
            expected = results[3][parameter]
            for other in results[:3]:
                assert (other[parameter] - expected).norm() <= 1e-4 * expected.norm() + 1e-9, name
