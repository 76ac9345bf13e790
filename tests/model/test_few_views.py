# SPDX-License-Identifier: Apache-2.0
"""What keeps a head from learning few views by heart: a late start, a smaller head, and shrinkage."""

import pytest
import torch
from short_trainings import checkpoint_of, command_line, models_of, trained
from torch.testing import assert_close

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.checkpoint import differences, reduced_config
from nrfgs_ns.training.run import parse

QUICK = {"--pipeline.model.num-downscales": 0, "--pipeline.model.warmup-length": 2, "--pipeline.model.refine-every": 4}


def ready(scene, out, steps, *options):
    """A trainer before its first step."""
    trainer = parse(command_line("nrfgs", scene, out, steps, QUICK, *options)).setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def test_the_head_rests_until_its_share_of_the_training_is_over(tiny_scene, tmp_path, no_cuda):
    trainer = ready(tiny_scene, tmp_path, 10, {"--pipeline.model.head-from": 0.4})
    model = trainer.pipeline.model
    latents = model.gauss_params["latents"].detach().clone()
    head = [weight.detach().clone() for weight in model.head.parameters()]
    base = model.gauss_params["features_dc"].detach().clone()
    for step in range(4):
        trainer.train_iteration(step)
    assert not torch.equal(model.gauss_params["features_dc"], base)
    assert torch.equal(model.gauss_params["latents"], latents)
    assert all(map(torch.equal, model.head.parameters(), head))
    trainer.train_iteration(4)
    assert not all(map(torch.equal, model.head.parameters(), head)), "it never begins"


def test_a_head_that_learns_goes_on_in_a_longer_training(tiny_scene, tmp_path, no_cuda):
    options = {"--pipeline.model.head-from": 0.4}
    config = trained(command_line("nrfgs", tiny_scene, tmp_path / "short", 5, QUICK, options))
    assert checkpoint_of(config)["pipeline"]["_model._extra_state"]["head_has_begun"] is True
    trainer = ready(tiny_scene, tmp_path / "long", 100, options, {"--load-dir": models_of(config)})
    trainer.train_iteration(5)
    assert not trainer.pipeline.model.head_rests


def test_many_views_have_no_late_start_and_no_shrinkage(tiny_scene, tmp_path, no_cuda, monkeypatch):
    monkeypatch.setattr("nrfgs_ns.model.model.MANY_VIEWS", 8)
    trainer = ready(tiny_scene, tmp_path, 5, {"--schedule-steps": 50})
    trainer.train_iteration(0)
    assert trainer.pipeline.model.num_train_data == 8
    assert not trainer.pipeline.model.head_rests and trainer.pipeline.model.shrinking() == {}


def test_it_rests_by_itself_where_schedules_are_stretched(tiny_scene, tmp_path, no_cuda):
    for stretched, rests in (({}, False), ({"--schedule-steps": 50}, True)):
        trainer = ready(tiny_scene, tmp_path, 5, stretched)
        trainer.train_iteration(0)
        assert trainer.pipeline.model.head_rests is rests


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_a_share_out_of_range_is_refused(share, tiny_scene, tmp_path, no_cuda):
    with pytest.raises(InputError, match=f"head_from is {share}"):
        ready(tiny_scene, tmp_path, 1, {"--pipeline.model.head-from": share})


def test_few_views_have_a_smaller_head_and_longer_noise(tiny_scene, tmp_path, no_cuda, capsys):
    model = ready(tiny_scene, tmp_path / "few", 1).pipeline.model
    assert (model.head.config.num_bands, model.head.config.opacity_residual) == (1, False)
    assert model.head.high is None and model.noise_factor == 1.0
    assert "views are few, so the head has num_bands 1, opacity_residual False" in capsys.readouterr().out
    model = ready(tiny_scene, tmp_path / "many", 1, {"--pipeline.model.few-views": "off"}).pipeline.model
    assert model.head.config == NrfConfig() and model.noise_factor == 0.5


def test_a_checkpoint_keeps_its_head_whatever_the_number_of_views(tiny_scene, tmp_path, no_cuda):
    for kept, asked in (("on", "off"), ("off", "on")):
        config = trained(
            command_line("nrfgs", tiny_scene, tmp_path / kept, 2, QUICK, {"--pipeline.model.few-views": kept})
        )
        state = checkpoint_of(config)["pipeline"]
        state = {name.removeprefix("_model."): value for name, value in state.items() if name.startswith("_model.")}
        other = ready(tiny_scene, tmp_path / "other", 1, {"--pipeline.model.few-views": asked}).pipeline.model
        other.load_state_dict(state)
        assert (other.head.high is None) == (kept == "on")
        assert_close(other.head.state_dict()["low.0.weight"], state["head.low.0.weight"])


def test_only_a_field_has_less_to_say_of_few_views():
    few = NrfConfig(latent_dim=8).for_few_views()
    assert differences(NrfConfig(latent_dim=8), few) == {"num_bands": 1, "opacity_residual": False}
    told = {"_extra_state": {"capacity": {"head": differences(NrfConfig(latent_dim=8), few)}}}
    assert reduced_config(NrfConfig(latent_dim=8), told) == few
    assert ShConfig().for_few_views() == ShConfig()


def test_shrinkage_falls_with_the_square_of_the_number_of_views(tiny_scene, tmp_path, no_cuda):
    model = ready(tiny_scene, tmp_path, 1, {"--pipeline.model.shrinkage": 0.5}).pipeline.model
    views, table = model.num_train_data, model.gauss_params
    terms = model.shrinking()
    assert_close(terms["shrink_opacities"], 0.5 / views**2 * torch.sigmoid(table["opacities"]).mean())
    assert_close(terms["shrink_scales"], 0.5 / views**2 * table["scales"].exp().mean() / model.scene_unit)
    model.config.densification = "mcmc"  # which has terms of its own
    assert model.shrinking() == {}
