# SPDX-License-Identifier: Apache-2.0
"""How long a part is on trial, against what, and who bears the burden of proof."""

import weakref
from types import SimpleNamespace

import pytest
import torch
from short_trainings import command_line

from nrfgs_ns.capacity import search
from nrfgs_ns.capacity.config import CapacitySearch
from nrfgs_ns.capacity.schedule import CapacitySchedule
from nrfgs_ns.capacity.search import Decision, Whole, decide, loss_of, mean, rest_for_latents, try_without
from nrfgs_ns.capacity.settle import Settled, Settling
from nrfgs_ns.studies.run import parse

ALLOWED = 0.025


class Scores(list):
    """In place of a field: what each view scores with it."""

    bytes = 0


class Told:
    """In place of a settling: what a field scores after each round, known beforehand."""

    def __init__(self, *rounds: list[float]):
        self.rounds, self.made, self.steps = rounds, 0, 0

    def advance(self) -> Settled:
        self.steps = 2 * self.steps or 100
        self.made += 1
        return Settled(Scores(self.rounds[self.made - 1]), {}, self.steps)


ASIDE = SimpleNamespace(scores=list, psnr=mean)
REFERENCE = [30.0, 31.5, 31.75, 32.0, 32.5]
"""The whole field's score after each round: two rounds are never alike."""


def tried(losses: list[float], most: int = 1600, whole: Whole | None = None, spread: tuple[float, ...] = (0.0,)):
    """Try a field that loses so much after each round, on views that differ from that by `spread`."""
    whole = whole or Whole(Told(*([score] * len(spread) for score in REFERENCE)), ASIDE)
    told = Told(*([score - loss - by for by in spread] for score, loss in zip(REFERENCE, losses, strict=False)))
    return try_without("part", Scores([20.0]), told, whole, ASIDE, ALLOWED, most)


def steps_of(trial) -> list[int]:
    return [steps for steps, _, _ in trial.rounds]


def test_a_part_whose_loss_halves_is_tried_on_and_goes_at_last():
    trial, settled = tried([0.16, 0.08, 0.04, 0.02, 9.0])
    assert trial.dropped and steps_of(trial) == [100, 200, 400, 800] and trial.steps == settled.steps == 800
    assert [loss for _, loss, _ in trial.rounds] == pytest.approx([0.16, 0.08, 0.04, 0.02])
    assert settled.field == [32.0 - 0.02], "that of the last round"
    assert (trial.loss_db, trial.psnr) == pytest.approx((0.02, 31.98))


@pytest.mark.parametrize(
    "losses, steps",
    [
        ([1.0, 1.0, 0.0], [100, 200]),
        ([1.0, 1.5, 0.0], [100, 200]),
        ([1.0, 0.76, 0.0], [100, 200]),
        ([1.0, 0.74, 0.6, 0.0], [100, 200, 400]),
    ],
)
def test_a_part_stays_once_a_round_does_not_take_off_a_quarter(losses, steps):
    trial, settled = tried(losses)
    assert not trial.dropped and settled is None and steps_of(trial) == steps


@pytest.mark.parametrize("most, last", [(100, 100), (199, 100), (200, 200), (1000, 800), (1600, 1600)])
def test_a_trial_has_no_more_steps_than_may_be(most, last):
    trial, _ = tried([1.6, 0.8, 0.4, 0.2, 0.1], most)
    assert not trial.dropped and trial.steps == last


@pytest.mark.parametrize("loss, goes", [(0.12, True), (0.13, False)])
def test_the_burden_of_proof_is_on_the_part(loss, goes):
    """Two views that differ by 0.2 dB: the standard error of their mean is 0.1, and 0.125 may go. With one, 0.025."""
    trial, _ = tried([loss], 100, spread=(-0.1, 0.1))
    assert (trial.error_db, trial.allowed_db, trial.limit_db) == pytest.approx((0.1, 0.025, 0.125))
    assert trial.dropped == goes
    alone, _ = tried([loss], 100)
    assert (alone.error_db, alone.limit_db, alone.dropped) == (0.0, 0.025, False)
    assert tried([0.024], 100)[0].dropped


def test_the_whole_field_settles_as_far_as_it_is_asked_to_and_once():
    told = Told(*([score] for score in REFERENCE))
    whole = Whole(told, ASIDE)
    made = []
    for losses in ([0.0], [1.0, 0.5, 0.45], [1.0, 0.9], [0.02]):
        trial, _ = tried(losses, whole=whole)
        # As whole rounds differ by a quarter of a decibel and more, one of another round would show.
        assert [loss for _, loss, _ in trial.rounds] == pytest.approx(losses)
        made.append(told.made)
    assert made == [1, 3, 3, 3]
    trial = whole.trial(Scores([12.0]))
    assert (trial.steps, trial.psnr, trial.psnr_at_once) == (400, REFERENCE[2], 12.0)
    assert steps_of(trial) == [100, 200, 400]


@pytest.mark.parametrize("lost, rest", [(-0.4, 0.05), (0.0, 0.05), (0.01, 0.04), (0.025, 0.025), (0.3, 0.025)])
def test_latents_may_take_what_parts_have_left(lost, rest):
    """Half of the tolerance at least, even if what was dropped seems worth more and is within its standard error."""
    assert rest_for_latents(0.05, lost) == pytest.approx(rest)


KEPT = (1000.0, 0.0)


@pytest.mark.parametrize(
    "losses, dropped, steps, rest",
    [
        # high branch; opacity's residual and distance, for as many steps; latents
        ([KEPT, (900.0, 0.0), (300.0, 400.0), *[KEPT] * 6, (899.0, 0.0)], "high branch", [8] * 5, 900.0),
        ([*[KEPT] * 6, (999.0, 0.0)], None, [4, 4, 4, 4, 4], 1000.0),
    ],
    ids=["after three rounds", "nothing"],
)
@pytest.mark.usefixtures("no_cuda")
def test_latents_are_cut_from_the_last_round_and_settle_as_long(
    losses, dropped, steps, rest, tiny_scene, tmp_path, monkeypatch
):
    """Losses are told, all else is real. Of whole and smaller fields there are two at a time that learn."""
    options = {"--pipeline.model.capacity": "auto", "--pipeline.model.appearance.latent-dim": 6}
    trainer = parse(command_line("nrfgs", tiny_scene, tmp_path, 2, options)).setup(local_rank=0, world_size=1)
    trainer.setup()
    alive, first = weakref.WeakSet(), []

    class Watched(Settling):
        def __init__(self, *args):
            super().__init__(*args)
            alive.add(self)
            first.append(self.first)
            assert len(alive) <= 2

    told = iter(losses)
    monkeypatch.setattr(search, "Settling", Watched)
    monkeypatch.setattr(search, "loss_of", lambda *_: next(told))
    monkeypatch.setattr(search, "SHARE_FOR_PARTS", 0.1)
    monkeypatch.setattr(search, "CLOSING", 0.1)
    model, data = trainer.pipeline.model, trainer.pipeline.datamanager
    found = decide(model, data, trainer.optimizers.optimizers, CapacitySearch(settle=2, tolerance_db=1000.0))
    assert next(told, None) is None
    assert found.dropped == [*([dropped] if dropped else []), "latents beyond rank 1"]
    assert [trial.steps for trial in found.trials] == steps
    assert found.trials[-1].allowed_db == rest
    assert first == [2] * (len(steps) - 1) + [steps[-1]]
    latents = found.chosen.field.splats["latents"]
    assert found.chosen.steps == steps[-1] and found.chosen.moments["latents"][latents]["step"] == steps[-1]


@pytest.mark.parametrize(
    "losses, parts, steps",
    [
        # What still lacks the high branch lacks more at first, and is not given up before it has caught up.
        ([0.16, 0.08, 0.02, *[0.16, 0.15, 0.02], *[0.16, 0.15, 0.02]], "hod", [400, 400, 400]),
        # After the distance has gone, the two others are tried once more; after nothing has, nothing is.
        ([*[1.0] * 2, *[1.0] * 2, 0.02, *[1.0] * 2, *[1.0] * 2], "hodho", [200, 200, 100, 200, 200]),
        # Opacity's residual went last: the distance has been tried without it, the high branch has not.
        ([*[1.0] * 2, 0.02, *[1.0] * 2, *[1.0] * 2], "hodh", [200, 100, 200, 200]),
        ([1.0] * 6, "hod", [200, 200, 200]),
    ],
)
@pytest.mark.usefixtures("no_cuda")
def test_what_is_tried_and_how_long(losses, parts, steps, tiny_scene, tmp_path, monkeypatch):
    options = {"--pipeline.model.capacity": "auto", "--pipeline.model.appearance.latent-dim": 6}
    trainer = parse(command_line("nrfgs", tiny_scene, tmp_path, 2, options)).setup(local_rank=0, world_size=1)
    trainer.setup()
    told = iter([*losses, 9.0])
    monkeypatch.setattr(search, "loss_of", lambda *_: (next(told, 9.0), 0.0))
    monkeypatch.setattr(Settling, "_learn", lambda *_: None)
    model, data = trainer.pipeline.model, trainer.pipeline.datamanager
    found = decide(model, data, trainer.optimizers.optimizers, CapacitySearch())
    tried = [trial for trial in found.trials[1:] if not trial.part.startswith("latents")]
    assert "".join(trial.part[0] for trial in tried) == parts and [trial.steps for trial in tried] == steps


@pytest.mark.usefixtures("no_cuda")
def test_settling_leaves_no_gradients_and_holds_no_photographs(tiny_scene, tmp_path, monkeypatch):
    """Poses would have them added to those of the training; of a large data set not all fit on the device."""
    options = {"--pipeline.model.camera-optimizer.mode": "SO3xR3", "--pipeline.model.capacity": "auto"}
    trainer = parse(command_line("nrfgs", tiny_scene, tmp_path, 2, options)).setup(local_rank=0, world_size=1)
    trainer.setup()
    model, data = trainer.pipeline.model, trainer.pipeline.datamanager
    given, most, view = weakref.WeakSet(), [], data.train_view

    def watched(index: int):
        camera, batch = view(index)
        batch = {**batch, "image": batch["image"].clone()}
        given.add(batch["image"])
        most.append(len(given))
        return camera, batch

    monkeypatch.setattr(data, "train_view", watched)
    decide(model, data, trainer.optimizers.optimizers, CapacitySearch(settle=4, settle_most=8))
    assert len(most) > 8 and max(most) <= len(data.views_aside) + 2
    assert all(parameter.grad is None for parameter in model.parameters())


def test_what_is_told(capsys):
    trials = [tried([0.0])[0], tried([0.16, 0.08, 0.04, 0.02])[0], tried([1.0, 1.0], spread=(-0.1, 0.1))[0]]
    schedule = SimpleNamespace(
        config=CapacitySearch(),
        model=SimpleNamespace(capacity_found={"step": 9, "head": {}}, num_points=1),
        data=SimpleNamespace(views_aside=[0], train_dataset=SimpleNamespace(image_filenames=["a.png"])),
        folder=None,
    )
    CapacitySchedule.tell(schedule, Decision(None, trials, []), 9, 1.0)
    said = " ".join(capsys.readouterr().out.split())
    assert "every part of the field pays; it stays whole" in said
    assert "dropped: part, worth 0.020 dB after 800 steps (standard error 0.000; up to 0.025 may go)" in said
    assert "kept: part, worth 1.000 dB after 200 steps (standard error 0.100; up to 0.125 may go)" in said


def test_a_loss_is_the_mean_of_what_each_view_lacks():
    loss, error = loss_of([29.0, 30.0, 28.0], [30.0, 30.0, 30.0])
    # Losses 1, 0 and 2: a standard deviation of 1, over the root of three views.
    assert loss == pytest.approx(1.0) and error == pytest.approx(3**-0.5)
    assert torch.tensor(loss_of([], [])).isnan()[0], "no view: nothing is dropped"
