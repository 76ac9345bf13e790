# SPDX-License-Identifier: Apache-2.0
"""The progress line, and that it changes no number."""

import io
import re

import pytest
from rich.console import Console
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained

from nrfgs_ns.training import pipeline, progress
from nrfgs_ns.training.progress import ProgressLine, ProgressLineConfig
from nrfgs_ns.training.trainer import writer

pytestmark = pytest.mark.usefixtures("no_cuda")

SPOKEN = {"--logging.local-writer.enable": True, "--logging.steps-per-log": 1}


@pytest.fixture
def screen(monkeypatch):
    """The line's output; it is updated at every step."""

    def made(terminal: bool) -> io.StringIO:
        file = io.StringIO()
        console = Console(file=file, force_terminal=terminal, width=200, legacy_windows=False)
        monkeypatch.setattr(progress, "CONSOLE", console)
        monkeypatch.setattr(pipeline, "CONSOLE", console)  # of an evaluation's progress bar
        return file

    monkeypatch.setattr(progress, "SHORTEST", 0.0)
    monkeypatch.setattr(progress, "SHARE", float("inf"))
    return made


def test_a_training_with_the_line_is_the_one_without(screen, tiny_scene, tmp_path, monkeypatch):
    """The second goes on from a checkpoint, though nerfstudio names step 0 with what it logs before the first step."""
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)
    said = screen(terminal=False)
    options = {"--pipeline.model.densification": "splatfacto,warmup_length=2,refine_every=4"}
    half = trained(command_line("nrfgs", tiny_scene, tmp_path / "half", 6, options))
    load = {"--load-dir": models_of(half)}
    quiet = trained(command_line("nrfgs", tiny_scene, tmp_path / "quiet", 12, options, load))
    assert not said.getvalue()
    spoken = trained(command_line("nrfgs", tiny_scene, tmp_path / "spoken", 12, options, load, SPOKEN))
    assert_same_training(checkpoint_of(quiet), checkpoint_of(spoken), rtol=0.0, atol=0.0)

    lines = said.getvalue().splitlines()
    form = re.compile(
        r"step (\d+) of 12 \(\d+ %\), (\d+\.\d) dB on test view (\S+\.png)(?:, \S+ steps/s(?:, .+ left)?)?"
    )
    matches = [form.fullmatch(line) for line in lines]
    assert all(matches) and [int(match[1]) for match in matches] == [*range(7, 13), 12]
    assert all(5 < float(match[2]) < 50 for match in matches) and len({match[3] for match in matches}) == 1
    assert "left" in lines[3] and "left" not in lines[-1]


def test_on_a_terminal_the_line_makes_room_for_an_evaluation(screen, tiny_scene, tmp_path):
    said = screen(terminal=True)
    trained(command_line("nrfgs", tiny_scene, tmp_path, 6, SPOKEN, {"--steps-per-eval-all-images": 3}))
    text = said.getvalue()
    assert "Evaluating" in text and "\x1b[" in text
    assert text.index("Evaluating") < text.index("step 5 of 6") < text.index("step 6 of 6 (100 %)")


@pytest.mark.parametrize("seconds_a_step", [0.01, 7.0])
def test_in_a_file_there_is_a_line_each_minute(seconds_a_step, screen, monkeypatch):
    said, now = screen(terminal=False), [0.0]
    line = ProgressLine(ProgressLineConfig(), clock=lambda: now[0])
    monkeypatch.setitem(writer.GLOBAL_BUFFER, "max_iter", 1_000_000)
    written, printed = [], 0
    for step in range(round(600 / seconds_a_step)):
        now[0] += seconds_a_step
        line.write_stats_log(step)
        if len(said.getvalue()) > printed:
            printed = len(said.getvalue())
            written.append(now[0])
    gaps = [after - before for before, after in zip(written, written[1:], strict=False)]
    assert max(gaps) <= 60 and min(gaps) >= progress.SECONDS_BETWEEN_LINES - 1e-6 and written[0] == seconds_a_step
