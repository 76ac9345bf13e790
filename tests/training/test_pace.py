# SPDX-License-Identifier: Apache-2.0
"""A time budget is kept whatever steps cost, stretched schedules are the plain ones elsewhere, and both continue."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import REFINING, assert_same_training, checkpoint_of, command_line, models_of, trained

from nrfgs_lab.training_run import train
from nrfgs_ns.errors import InputError
from nrfgs_ns.method_config import nrfgs
from nrfgs_ns.training import pace, trainer_config
from nrfgs_ns.training.checkpoint_files import find, read
from nrfgs_ns.training.pace import Pace, TimedPace, steps_for

LENGTH = 30_000


def walk(budget, cost, doublings=()):
    """A training whose step at a position costs `cost(position, step)` seconds; the pace, its seconds and positions."""
    now, positions = 100.0, []
    pace = TimedPace(LENGTH, budget, doublings, lambda: now)
    pace.start()
    while not pace.is_spent:
        positions.append(pace.position)
        now += cost(pace.position, len(positions))
        pace.advance()
    return pace, now - 100.0, positions


@given(
    st.floats(0.001, 0.5),  # seconds a step
    st.floats(0.2, 5.0),  # by how much steps become dearer towards the end
    st.floats(0.0, 3.0),  # seconds that an evaluation takes every hundredth step
    st.integers(200, 2000),  # how many steps of the first kind would fit in
)
def test_the_budget_is_kept(first, growth, pause, fits):
    """The end is within half a step and one pause of the budget, whatever happens: training stops by the clock. And
    the schedules are walked to their end, to 2 %, unless a pause comes as a surprise in the last steps."""
    budget = first * fits

    def cost(position, step):
        return first * growth ** (position / LENGTH) + (pause if step % 100 == 0 else 0.0)

    pace, seconds, positions = walk(budget, cost)
    longest = first * max(1.0, growth)
    assert budget - longest <= seconds <= budget + longest + pause
    assert positions == sorted(positions) and positions[-1] <= LENGTH
    if pause < 0.02 * budget:
        assert pace.position >= 0.9 * LENGTH


def test_what_steps_cost_decides_how_evenly_they_are_spread():
    """Steps at half the resolution take half the time, as the pace takes them to: as many positions for each step early
    on as later. Of a pace that knows no doubling, early steps look cheap for ever, and more of them are made."""

    def cost(position, step):
        return 0.5 if position < 15_000 else 1.0

    def early(positions):
        return sum(position < 15_000 for position in positions) / len(positions)

    assert early(walk(3000.0, cost, [15_000])[2]) == pytest.approx(0.5, abs=0.01)
    assert early(walk(3000.0, cost)[2]) > 0.55
    twice = TimedPace(LENGTH, 1.0, [3000, 6000])
    for position, ahead in ((0.0, 105_000.0), (3000.0, 51_000.0), (6000.0, 24_000.0), (LENGTH, 0.0)):
        twice.position = position
        assert twice._cost_ahead() == ahead


def test_beyond_the_schedules_the_clock_says_how_many_steps_are_left():
    """Of a training that goes on with a larger budget after its end, whose mean would be of all further steps."""
    now, left = 0.0, []
    pace = TimedPace(LENGTH, 20.0, clock=lambda: now)
    pace.load_state({"length": LENGTH, "rate": 100.0, "position": float(LENGTH), "seconds": 10.0})
    pace.start()
    while not pace.is_spent:
        now += 0.1
        pace.advance()
        left.append(pace.steps_left)
    assert left == [*range(99, -1, -1)]


def test_steps_of_positions():
    pace = Pace(LENGTH, rate=30.0)
    assert pace.step_at(0, 0) == 0 and pace.step_at(1, 0) == 1 and pace.step_at(500, 0) == 17  # 17 * 30 = 510
    for _ in range(20):
        pace.advance()
    assert pace.position == 600.0
    assert pace.step_at(500, 20) == 0 and pace.step_at(600, 20) == 20  # behind, and here
    assert pace.step_at(15_000, 20) == 500 and pace.step_at(15_001, 20) == 501
    for _ in range(2000):
        pace.advance()
    assert pace.position == LENGTH


RULES = "splatfacto,warmup_length=8,refine_every=2,reset_alpha_every=100,densify_grad_thresh=1e-6,stop_split_at=30"
SCHEDULES = {
    "--pipeline.model.densification": RULES,
    "--pipeline.model.resolution-schedule": 10,
    "--pipeline.model.num-downscales": 1,
}
"""All that has a schedule, laid out for 40 steps."""
SH = {**SCHEDULES, "--pipeline.model.appearance.degree-interval": 10}
CALM = {"--pipeline.model.densification": "splatfacto,refine_every=1000"}
"""No densification, which every second step would double the splats until a step takes a second."""
STRETCHED = {"--schedule-steps": 40, "--steps-per-save": 3}


@pytest.fixture(scope="module")
def stretched(tiny_scene, tmp_path_factory):
    """config.yml of 20 steps of the 40, with a checkpoint of every third."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)  # as where it goes on
        every = {"--save-only-latest-checkpoint": False}
        return trained(command_line("nrfgs-sh", tiny_scene, tmp_path_factory.mktemp("out"), 20, SH, STRETCHED, every))


@pytest.mark.usefixtures("no_cuda")
def test_a_stretched_training(stretched):
    """Degree 3 is reached at step 15, and its harmonics are there when it is evaluated; splats come only before it."""
    _, pipeline, _, step = eval_setup(stretched)
    assert step == 19 and pipeline.model.head.active_degree == 3
    assert pipeline.model.schedule_step == 40
    saved = {step: read(p)["pipeline"]["_model.gauss_params.means"] for step, p in find(models_of(stretched)).items()}
    counts = {step: len(means) for step, means in saved.items()}
    # 8 training images hold densification back for 8 + 2 steps after the reset at 0: it acts at steps 10, 12 and 14.
    assert counts[3] == counts[9] < counts[12] < counts[15] == counts[18] == pipeline.model.num_points
    assert checkpoint_of(stretched)["training"]["pace"] == {"length": 40, "rate": 2.0, "position": 40.0}


@pytest.mark.usefixtures("no_cuda")
def test_a_stretched_training_continues_to_the_bit(stretched, tiny_scene, tmp_path):
    load = {"--load-dir": models_of(stretched), "--load-step": 9}
    rest = trained(command_line("nrfgs-sh", tiny_scene, tmp_path / "rest", 20, SH, STRETCHED, load))
    one, other = checkpoint_of(stretched), checkpoint_of(rest)
    assert one["step"] == 19
    assert_same_training(one, other, rtol=0, atol=0)
    assert one["schedulers"] == other["schedulers"]
    with pytest.raises(InputError, match="schedule-steps"):
        train(command_line("nrfgs-sh", tiny_scene, tmp_path / "plain", 20, SH, load))


class SecondsAStep(TimedPace):
    def __init__(self, *args):
        self.now = 0.0
        super().__init__(*args, clock=lambda: self.now)

    def advance(self):
        self.now += 1.0
        super().advance()


@pytest.mark.usefixtures("no_cuda")
def test_a_training_ends_when_its_time_is_up(tiny_scene, tmp_path, monkeypatch):
    """It is saved by its last step's name, refuses the same budget, and makes six more steps of six more seconds."""
    monkeypatch.setattr(trainer_config, "TimedPace", SecondsAStep)

    def run(name, minutes, *more):
        options = SCHEDULES, CALM, {"--time-budget": minutes}, *more
        record = train(command_line("nrfgs", tiny_scene, tmp_path / name, 40, *options))
        config = Path(record.config_path)
        state = checkpoint_of(config)
        return record, models_of(config), state["step"], state["training"]["pace"]

    record, folder, last, pace = run("a", 0.2)
    assert record.steps == 12 and last == 11 and record.saved == [[11, record.seconds]]
    assert pace["position"] > 36 and pace["seconds"] == 12
    with pytest.raises(InputError, match="used its time budget of 0.2 minutes. A larger --time-budget goes on"):
        run("b", 0.2, {"--load-dir": folder})
    record, _, last, pace = run("c", 0.3, {"--load-dir": folder})
    assert record.steps == 6 and last == 17 and pace["seconds"] == 18


def test_what_is_left_open_is_chosen_and_what_is_given_stays():
    few_and_many = {1: 10_000, 83: 10_000, 84: 10_080, 250: 30_000, 5000: 30_000}
    assert {views: steps_for(views) for views in few_and_many} == few_and_many

    def chosen(**options):
        config = replace(nrfgs.config, **options).for_views(60)
        return config.max_num_iterations, config.schedule_steps, config.average_steps

    assert chosen() == (10_000, 30_000, 200)
    assert nrfgs.config.max_num_iterations == 0, "the registered configuration was changed"
    assert chosen(max_num_iterations=700) == (700, None, 0)
    assert chosen(schedule_steps=7, average_steps=0) == (10_000, 7, 0)
    assert chosen(time_budget=2.0) == (30_000, 30_000, 200)


def test_chosen_steps_are_made_and_resuming_goes_on_to_their_end(tiny_scene, tmp_path, no_cuda, capsys, monkeypatch):
    """The rule in miniature: 12 steps for the tiny scene's 8 views, of schedules for 30."""
    monkeypatch.setattr(pace, "STEPS_PER_VIEW", 1)
    for module in (pace, trainer_config):
        for name, value in (("FEWEST_STEPS", 12), ("STEPS", 30)):
            monkeypatch.setattr(module, name, value)

    def train_on(name, steps, *more):
        return trained(command_line("nrfgs", tiny_scene, tmp_path / name, steps, REFINING, *more))

    whole = train_on("whole", 0, {"--steps-per-save": 5})
    said = " ".join(capsys.readouterr().out.split())
    chosen = r"8 training views: 12 steps, view dependence reduced to 0.29, .*nothing drawn nearer than \d"
    assert re.search(chosen, said)
    last = {"--load-dir": models_of(whole)}
    assert checkpoint_of(train_on("rest", 0, last, {"--load-step": 10}))["step"] == checkpoint_of(whole)["step"] == 11
    with pytest.raises(InputError, match="end of a training of 12 steps: --max-num-iterations 24 --schedule-steps 30"):
        train_on("again", 0, last)
    for other in {}, {"--schedule-steps": 24}:
        with pytest.raises(InputError, match="Go on with --schedule-steps 30"):
            train_on("again", 24, last, other)
    assert checkpoint_of(train_on("more", 14, last, {"--schedule-steps": 30}))["step"] == 13
