# SPDX-License-Identifier: Apache-2.0
"""What a training says on the terminal, and that saying it changes nothing."""

import io
import re

import pytest
from rich.console import Console
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained

from nrfgs_ns.training import pipeline, progress
from nrfgs_ns.training.progress import duration

pytestmark = pytest.mark.usefixtures("no_cuda")

SPOKEN = {"--logging.local-writer.enable": True, "--logging.steps-per-log": 1}


@pytest.fixture
def screen(monkeypatch):
    """Where the line is written, at every step: a terminal if asked for."""

    def made(terminal: bool) -> io.StringIO:
        file = io.StringIO()
        console = Console(file=file, force_terminal=terminal, width=200, legacy_windows=False)
        monkeypatch.setattr(progress, "CONSOLE", console)
        monkeypatch.setattr(pipeline, "CONSOLE", console)  # which shows how far an evaluation is
        return file

    monkeypatch.setattr(progress, "SHORTEST", 0.0)
    monkeypatch.setattr(progress, "SHARE", float("inf"))
    return made


def test_a_training_with_the_line_is_the_one_without(screen, tiny_scene, tmp_path):
    said = screen(terminal=False)
    options = {"--pipeline.model.densification": "splatfacto,warmup_length=2,refine_every=4"}
    quiet = trained(command_line("nrfgs", tiny_scene, tmp_path / "quiet", 12, options))
    assert not said.getvalue()
    spoken = trained(command_line("nrfgs", tiny_scene, tmp_path / "spoken", 12, options, SPOKEN))
    assert_same_training(checkpoint_of(quiet), checkpoint_of(spoken), rtol=0.0, atol=0.0)

    lines = said.getvalue().splitlines()
    form = re.compile(
        r"step (\d+) of 12 \(\d+ %\), (\d+\.\d) dB on test view (\S+\.png)(?:, \S+ steps/s(?:, .+ left)?)?"
    )
    found = [form.fullmatch(line) for line in lines]
    assert all(found) and len(lines) == 13, "one for each step, and what has become of it"
    assert [int(one[1]) for one in found] == [*range(1, 13), 12]
    assert all(5 < float(one[2]) < 50 for one in found) and len({one[3] for one in found}) == 1
    assert "left" in lines[5] and "left" not in lines[-1]


def test_on_a_terminal_the_line_makes_room_for_an_evaluation(screen, tiny_scene, tmp_path):
    said = screen(terminal=True)
    evaluated = {"--steps-per-eval-all-images": 3, "--vis": "tensorboard"}
    trained(command_line("nrfgs", tiny_scene, tmp_path, 6, SPOKEN, evaluated))
    text = said.getvalue()
    assert "Evaluating" in text and "\x1b[" in text
    assert text.index("Evaluating") < text.index("step 5 of 6") < text.index("step 6 of 6 (100 %)")


def test_a_continued_training_begins_at_its_step(screen, tiny_scene, tmp_path):
    """Though nerfstudio names step 0 with what it logs before the first one."""
    first = trained(command_line("nrfgs", tiny_scene, tmp_path / "first", 4))
    said = screen(terminal=False)
    more = {"--load-dir": models_of(first), "--vis": "tensorboard"}
    trained(command_line("nrfgs", tiny_scene, tmp_path / "more", 8, SPOKEN, more))
    steps = [int(line.split()[1]) for line in said.getvalue().splitlines() if line.startswith("step ")]
    assert steps == [5, 6, 7, 8, 8]


def test_in_a_file_lines_are_few(screen, tiny_scene, tmp_path):
    said = screen(terminal=False)
    trained(command_line("nrfgs", tiny_scene, tmp_path, 45, SPOKEN, {"--pipeline.model.num-downscales": 3}))
    assert len(said.getvalue().splitlines()) == progress.LINES_IN_A_FILE + 2


@pytest.mark.parametrize("seconds, text", [(0.2, "0 s"), (59.4, "59 s"), (80, "1 min 20 s"), (7500, "2 h 05 min")])
def test_durations(seconds, text):
    assert duration(seconds) == text
