# SPDX-License-Identifier: Apache-2.0
"""How long a training is where the number of views decides."""

from dataclasses import replace

import pytest
from short_trainings import checkpoint_of, command_line, models_of, trained

from nrfgs_ns.errors import InputError
from nrfgs_ns.method_config import nrfgs, nrfgs_best, nrfgs_fast, nrfgs_sh
from nrfgs_ns.training import pace
from nrfgs_ns.training.pace import steps_for
from nrfgs_ns.training.run import parse

SMALL = {"--pipeline.model.num-downscales": 0, "--pipeline.model.warmup-length": 2, "--pipeline.model.refine-every": 4}
VIEWS = 8
"""Training views of the tiny scene."""


def test_few_views_have_ten_thousand_steps_and_many_thirty_thousand():
    assert [steps_for(views) for views in (1, 17, 83, 84, 150, 250, 255, 5000)] == [
        10_000, 10_000, 10_000, 10_080, 18_000, 30_000, 30_000, 30_000,
    ]  # fmt: skip


def test_what_is_left_open_is_chosen_and_what_is_said_stays():
    chosen = nrfgs.config.for_views(60)
    assert (chosen.max_num_iterations, chosen.schedule_steps, chosen.average_steps) == (10_000, 30_000, 200)
    assert nrfgs.config.max_num_iterations == 0, "the registered configuration was changed"
    said = replace(nrfgs.config, max_num_iterations=700).for_views(60)
    assert (said.max_num_iterations, said.schedule_steps, said.average_steps) == (700, None, 0)
    own = replace(nrfgs.config, schedule_steps=7, average_steps=0).for_views(60)
    assert (own.max_num_iterations, own.schedule_steps, own.average_steps) == (10_000, 7, 0)
    timed = replace(nrfgs.config, time_budget=2.0).for_views(60)
    assert (timed.max_num_iterations, timed.schedule_steps, timed.average_steps) == (30_000, 30_000, 200)
    for other, steps in ((nrfgs_fast, 10_000), (nrfgs_best, 30_000), (nrfgs_sh, 30_000)):
        assert other.config.for_views(60).max_num_iterations == steps


@pytest.fixture
def short(monkeypatch):
    """The rule in miniature: 12 steps for the tiny scene's 8 views, of schedules for 30."""
    for module in (pace, __import__("nrfgs_ns.training.trainer", fromlist=["trainer"])):
        monkeypatch.setattr(module, "FEWEST_STEPS", 12)
        monkeypatch.setattr(module, "STEPS", 30)
        monkeypatch.setattr(module, "STEPS_PER_VIEW", 1)


def test_the_chosen_steps_are_made_and_an_interrupted_training_goes_on_to_their_end(
    short, tiny_scene, tmp_path, no_cuda, capsys
):
    whole = trained(command_line("nrfgs", tiny_scene, tmp_path / "whole", 0, SMALL))
    assert checkpoint_of(whole)["step"] == 11
    said = " ".join(capsys.readouterr().out.split())
    assert f"{VIEWS} training views, " in said
    assert "apart: 12 steps (1 a view, at least 12 and at most 30); the head sees each splat from about 0.5" in said

    config = parse(command_line("nrfgs", tiny_scene, tmp_path / "half", 0, SMALL, {"--steps-per-save": 5}))
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    step_of = trainer.train_iteration

    def interrupted(step):
        if step == 7:
            raise KeyboardInterrupt
        return step_of(step)

    trainer.train_iteration = interrupted
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    kept = trainer.checkpoint_dir
    on = trained(command_line("nrfgs", tiny_scene, tmp_path / "on", 0, SMALL, {"--load-dir": kept}))
    assert checkpoint_of(on)["step"] == 11
    last = {"--load-dir": models_of(on)}
    with pytest.raises(InputError, match="end of a training of 12 steps.* --max-num-iterations 24 --schedule-steps 30"):
        trained(command_line("nrfgs", tiny_scene, tmp_path / "rest", 0, SMALL, last))
    with pytest.raises(InputError, match="Go on with --schedule-steps 30"):
        trained(command_line("nrfgs", tiny_scene, tmp_path / "rest", 24, SMALL, last))
    assert not (tmp_path / "rest").exists()
    more = trained(command_line("nrfgs", tiny_scene, tmp_path / "more", 14, SMALL, last, {"--schedule-steps": 30}))
    assert checkpoint_of(more)["step"] == 13
