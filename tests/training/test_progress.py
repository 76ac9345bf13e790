# SPDX-License-Identifier: Apache-2.0
"""What is shown: the progress line, which changes no number, and an evaluation's table."""

import io
import re

import pytest
from rich.console import Console
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained

from nrfgs_ns.training import pipeline, progress
from nrfgs_ns.training.evaluation import print_evaluation

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


def test_an_evaluation_names_the_worst_view(capsys):
    views = [{"image": f"{psnr:g}.png", "psnr": psnr} for psnr in (25.0, 12.0, 26.0)] + [{"image": "masked.png"}]
    print_evaluation({"psnr": 21.0, "per_image": views})
    said = " ".join(capsys.readouterr().out.split())
    assert "Means over 4 test views" in said and "Median view 25.0 dB. Worst 12.0 dB: 12.png" in said
