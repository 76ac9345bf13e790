# SPDX-License-Identifier: Apache-2.0
"""The progress line, which changes no number."""

import io
import re

import pytest
from rich.console import Console
from short_trainings import assert_same_training, checkpoint_of, command_line, models_of, trained

from nrfgs_ns.training import progress

pytestmark = pytest.mark.usefixtures("no_cuda")

SPOKEN = {"--logging.local-writer.enable": True, "--logging.steps-per-log": 1}


def test_a_training_with_the_line_is_the_one_without(tiny_scene, tmp_path, monkeypatch):
    """The second goes on from a checkpoint, though nerfstudio names step 0 with what it logs before the first step."""
    said = io.StringIO()
    for name, value in (("SECONDS_BETWEEN_LINES", 0.0), ("SHORTEST", 0.0), ("SHARE", float("inf"))):
        monkeypatch.setattr(progress, name, value)
    monkeypatch.setattr(progress, "CONSOLE", Console(file=said, force_terminal=False, width=200))
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
