# SPDX-License-Identifier: Apache-2.0
"""The mean over a training's last steps: of which steps it is, and when it begins anew. test_ending.py resumes it."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from gsplat.strategy.ops import remove, reset_opa
from nerfstudio.utils.rich_utils import CONSOLE
from short_trainings import assert_same_training, checkpoint_of, command_line, set_up, trained
from torch.testing import assert_close

from nrfgs_ns.densification.mcmc import add_noise, relocate
from nrfgs_ns.training import averaging
from nrfgs_ns.training.averaging import ParameterMean, window
from nrfgs_ns.training.guard import TrainingStopped
from nrfgs_ns.training.pace import Pace, TimedPace
from nrfgs_ns.training.trainer import NrfgsTrainer

pytestmark = pytest.mark.usefixtures("no_cuda", "any_share")

CALM = {
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.densification": "splatfacto,refine_every=1000",
    "--pipeline.model.warmup-steps": 0,
}
"""Nothing but the optimisers changes parameters, after the reset of opacity at step 0."""


@pytest.fixture(scope="module")
def ready(tiny_scene, tmp_path_factory) -> NrfgsTrainer:
    """A trainer before its first step, whose optimisers have made one."""
    trainer = set_up(command_line("nrfgs", tiny_scene, tmp_path_factory.mktemp("r"), 10, CALM, {"--average-steps": 4}))
    a_step(trainer.pipeline.model, trainer.optimizers.optimizers)
    return trainer


@pytest.fixture
def trainer(ready) -> NrfgsTrainer:
    """The same one with an empty mean and without a pace."""
    ready.mean.forget()
    ready.pace, ready._start_step, ready.stop_training = None, 0, False
    ready.config.average_steps, ready.config.max_num_iterations = 4, 10
    return ready


def a_step(model, optimizers):
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    for optimizer in optimizers.values():
        optimizer.step()


CHANGES = {
    "relocated": (lambda m, adam: relocate(m.gauss_params, adam, torch.arange(len(m.means)) < 3), True),
    "reset": (lambda m, adam: reset_opa(m.gauss_params, adam, {}, 0.2), True),
    "removed": (lambda m, adam: remove(m.gauss_params, adam, {}, torch.arange(len(m.means)) < 3), True),
    "noise": (lambda m, adam: add_noise(m.gauss_params, 1.0, torch.zeros(len(m.means))), False),
    "a step": (a_step, False),
}


@pytest.mark.parametrize("change, anew", CHANGES.values(), ids=CHANGES.keys())
def test_what_gives_rows_another_meaning_begins_anew(change, anew, trainer):
    """The real changes on a real model."""
    model, mean = trainer.pipeline.model, ParameterMean()
    for _ in range(2):
        mean.add(trainer.optimizers.optimizers)
    change(model, trainer.optimizers.optimizers)
    mean.add(trainer.optimizers.optimizers)
    assert mean.count == (1 if anew else 3)
    if anew:  # nothing of the earlier rows is left in it
        now = {name: value.detach().clone() for name, value in model.gauss_params.items()}
        mean.install()
        assert_close(dict(model.gauss_params.items()), now, rtol=0, atol=0, check_stride=False)


def test_rows_that_a_strategy_overwrites_in_place_begin_it_anew(trainer, monkeypatch):
    assert counts(trainer, range(6, 8)) == [1, 2]
    monkeypatch.setattr(trainer.pipeline.model.densification, "moved_at", 8)
    assert counts(trainer, range(8, 10)) == [1, 2]


def test_a_short_training_averages_a_share_of_its_steps(monkeypatch):
    monkeypatch.setattr(averaging, "LARGEST_SHARE", 0.02)
    for asked, total, size in ((200, 30_000, 200), (200, 300, 6), (200, 20, 1), (7, 300, 6), (3, 300, 3)):
        assert window(asked, total) == size


def counts(trainer: NrfgsTrainer, steps: range) -> list[int]:
    """How many steps are in the mean after each of these."""
    found = []
    for step in steps:
        trainer._average(step)
        found.append(trainer.mean.count)
    return found


@pytest.mark.parametrize("pace", [None, Pace(40, rate=4.0)])
def test_the_window_of_a_training_with_known_length(pace, trainer):
    trainer.pace = pace
    assert counts(trainer, range(10)) == [0, 0, 0, 0, 0, 0, 1, 2, 3, 4]
    trainer.mean.forget()
    trainer.config.average_steps = 100
    assert counts(trainer, range(10)) == list(range(1, 11))  # all that there are


def test_the_window_of_a_training_that_goes_on(trainer):
    """Interrupted after step 7 of 10. Ten steps more instead of two: the last is 17, and what was in the mean is old.
    Three more instead of two: the window is 7 to 10, and the mean of 6 and 7 is not of that window."""
    for more, expected in ((10, [0] * 6 + [1, 2, 3, 4]), (3, [1, 2, 3]), (2, [3, 4])):
        trainer.mean.forget()
        trainer._start_step, trainer.config.max_num_iterations = 0, 10
        assert counts(trainer, range(8))[-1] == 2
        trainer._start_step, trainer.config.max_num_iterations = 8, more
        assert counts(trainer, range(8, 8 + more)) == expected


@pytest.fixture(scope="module")
def averaged(tiny_scene, tmp_path_factory, any_share):
    """A training of 12 steps that averages over the last 6: its parameters after each step, and its output."""
    after = {}
    with pytest.MonkeyPatch.context() as patch, CONSOLE.capture() as log:
        average = NrfgsTrainer._average

        def note(trainer, step):
            average(trainer, step)
            tensors = trainer.pipeline.model.state_dict().items()
            after[step] = {name: value.clone() for name, value in tensors if isinstance(value, torch.Tensor)}

        patch.setattr(NrfgsTrainer, "_average", note)
        args = command_line("nrfgs", tiny_scene, tmp_path_factory.mktemp("averaged"), 12, CALM, {"--average-steps": 6})
        config = trained(args)
    return SimpleNamespace(config=config, after=after, said=log.get())


def test_the_trained_model_is_the_mean(averaged):
    """Against a mean in float64. Parameters are up to 10; six float32 roundings of that, 6 * 10 * 6e-8."""
    saved = checkpoint_of(averaged.config)["pipeline"]
    for name in averaged.after[11]:
        expected = torch.stack([averaged.after[step][name].double() for step in range(6, 12)]).mean(dim=0)
        assert_close(saved[f"_model.{name}"].double(), expected, rtol=0, atol=4e-6)
    assert (saved["_model.gauss_params.means"] - averaged.after[11]["gauss_params.means"]).abs().max() > 1e-5
    assert "parameter_mean" not in checkpoint_of(averaged.config)["training"]
    assert "over the last 6 steps." in averaged.said


def test_averaging_changes_no_step(averaged, tiny_scene, tmp_path):
    """A training without it ends where one with it was before the mean took its place, moments included."""
    plain = checkpoint_of(trained(command_line("nrfgs", tiny_scene, tmp_path, 12, CALM)))
    last = {f"_model.{name}": value for name, value in averaged.after[11].items()}
    assert_close({name: plain["pipeline"][name] for name in last}, last, rtol=0, atol=0)
    with_it = checkpoint_of(averaged.config)
    with_it["pipeline"] = plain["pipeline"]
    assert_same_training(plain, with_it, rtol=0, atol=0)
    assert set(plain["training"]) == {"options"}


def test_what_ends_early_stays_the_last_steps(trainer, monkeypatch):
    """Stopped from outside, timed out before its window, or condemned in its last step."""
    means = trainer.pipeline.model.means
    monkeypatch.setattr("nrfgs_ns.training.trainer.Trainer._after_train", lambda trainer: None)
    counts(trainer, range(8))
    with torch.no_grad():
        means.add_(1.0)
    before = means.detach().clone()

    def end() -> str:
        with CONSOLE.capture() as log:
            trainer._after_train()
        return log.get()

    trainer.stop_training = True
    assert "stopped before its last step" in end()
    trainer.stop_training = False

    condemned = Mock(side_effect=TrainingStopped("a number", 9, "gradient", savable=False))
    with monkeypatch.context() as patch, pytest.raises(TrainingStopped):
        patch.setattr(trainer.guard, "settle", condemned)
        end()
    assert trainer.mean.count == 2
    trainer.mean.forget()
    trainer.pace, trainer.step = TimedPace(100, 0.0, clock=lambda: 1.0), 3
    assert "sooner than foreseen" in end()
    assert_close(means.detach(), before, rtol=0, atol=0)
