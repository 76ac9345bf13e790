# SPDX-License-Identifier: Apache-2.0
"""Trainings that are killed with -9 at random moments, most of them while they save, go on to the bit."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from short_trainings import assert_same_training, command_line

from nrfgs_ns.training.checkpoint_files import find, read_latest

SERVER = Path(__file__).resolve().parents[1] / "helpers" / "forked_trainings.py"
STEPS = 30
OPTIONS = {
    "--steps-per-save": 1,
    "--average-steps": 4,
    "--pipeline.model.warmup-length": 2,
    "--pipeline.model.refine-every": 4,
    "--pipeline.model.reset-alpha-every": 6,
    "--pipeline.model.densify-grad-thresh": 1e-6,
    "--pipeline.model.num-downscales": 0,
    "--timestamp": "run",
}
"""A checkpoint after each step; refinements and a reset of opacities happen."""


@pytest.fixture
def server():
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    process = subprocess.Popen(
        [sys.executable, str(SERVER)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    # What it says is read in the end only: the pipe must hold it all.
    os.set_blocking(process.stderr.fileno(), False)
    assert process.stdout.readline() == "ready\n", process.stderr.read()
    yield process
    process.stdin.close()
    process.wait()


def begin(server, args: list[str]) -> int:
    """Start a training; its process number."""
    print(json.dumps(args), file=server.stdin, flush=True)
    return int(server.stdout.readline())


def end(server) -> int:
    code = int(server.stdout.readline())
    server.stderr.read()  # lest the pipe be full
    return code


@pytest.mark.skipif(sys.platform != "linux", reason="forks a process that has imported torch")
@pytest.mark.parametrize("rounds", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_trainings_that_are_killed_go_on_to_the_bit(rounds, server, tiny_scene, tmp_path):
    draw = random.Random(0)

    def models(name: str) -> Path:
        return tmp_path / name / tiny_scene.name / "nrfgs" / "run" / "nerfstudio_models"

    def words(name: str, *more: dict) -> list[str]:
        return command_line("nrfgs", tiny_scene, tmp_path / name, STEPS, OPTIONS, *more)

    started = time.time()
    begin(server, words("whole"))
    assert end(server) == 0
    took = time.time() - started
    _, whole = read_latest(models("whole"))
    assert whole["step"] == STEPS - 1
    cut = 0
    for number in range(rounds):
        killed, goes_on = f"killed-{number}", f"goes-on-{number}"
        child = begin(server, words(killed))
        while not find(models(killed)):
            time.sleep(0.001)
        time.sleep(draw.uniform(0.0, 0.3 * took))
        os.kill(child, signal.SIGKILL)
        cut += end(server) == -signal.SIGKILL
        reached = read_latest(models(killed))[1]["step"]
        if reached == STEPS - 1:
            continue
        begin(server, words(goes_on, {"--load-dir": models(killed)}))
        assert end(server) == 0
        assert_same_training(whole, read_latest(models(goes_on))[1], rtol=0, atol=0)
    assert cut >= 0.7 * rounds, "most had ended before they were killed"
