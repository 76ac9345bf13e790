# SPDX-License-Identifier: Apache-2.0
"""What is said when a process is lost, and that nothing else is lost with it."""

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from short_trainings import command_line
from torch.multiprocessing import ProcessExitedException

from nrfgs_ns.distributed import launch
from nrfgs_ns.errors import InputError
from nrfgs_ns.method_config import nrfgs
from nrfgs_ns.training.checkpoint_files import read_latest


@pytest.fixture
def config(tmp_path):
    machine = replace(nrfgs.config.machine, num_devices=2, device_type="cpu")
    named = {"experiment_name": "x", "timestamp": "now"}
    return replace(nrfgs.config, data=tmp_path, output_dir=tmp_path, machine=machine, **named)


KILLED = ProcessExitedException("died", error_index=1, error_pid=7, exit_code=-9, signal_name="SIGKILL")


def test_what_cannot_start_is_refused_before_it_does(config, monkeypatch):
    with pytest.raises(InputError, match="nrfgs_lab.many_processes"):
        config.print_to_terminal()  # what ns-train does, on CPUs
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(InputError, match="num_devices is 2, but this machine shows 1"):
        launch.prepare(replace(config, machine=replace(config.machine, device_type="cuda")))


def test_ns_train_says_in_one_message_which_process_is_lost(config, monkeypatch, capsys):
    """It lets the exception of its children through to Python, which would print both their traceback and its own."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(sys, "excepthook", lambda kind, error, trace: print("as ever:", error, file=sys.stderr))
    replace(config, machine=replace(config.machine, device_type="cuda")).print_to_terminal()
    config.get_checkpoint_dir().mkdir(parents=True)
    (config.get_checkpoint_dir() / "step-000000010.ckpt").touch()
    sys.excepthook(type(KILLED), KILLED, None)
    sys.excepthook(ValueError, ValueError("another"), None)
    asked = ProcessExitedException("ended", error_index=1, error_pid=7, exit_code=130)
    with pytest.raises(SystemExit) as ended:
        sys.excepthook(type(asked), asked, None)
    assert ended.value.code == 130
    said = capsys.readouterr().err
    assert said.startswith("Training stopped: the process of device 1 of 2 was killed by SIGKILL. Out of memory")
    assert "step-000000010.ckpt; with --load-dir" in said
    assert said.endswith("as ever: another\n")


@pytest.mark.parametrize("option", ["mixed_precision", "use_grad_scaler"])
def test_scaled_gradients_are_refused(config, option):
    with pytest.raises(InputError, match=option):
        replace(config, **{option: True}).setup(local_rank=0, world_size=2)


@pytest.mark.parametrize("option", [{"twin": "on"}, {"robust_loss": 0.1}])
def test_a_twin_and_a_robust_loss_are_refused(config, option):
    config = replace(config, pipeline=replace(config.pipeline, model=replace(config.pipeline.model, **option)))
    with pytest.raises(InputError, match="model.twin and pipeline.model.robust_loss are for one device"):
        config.setup(local_rank=0, world_size=2)


def workers(parent: int) -> list[int]:
    """Processes that multiprocessing has spawned, in the order of their ranks."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [int(pid) for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


WAIT = 200
"""Seconds for a training to begin, and to end."""


@pytest.fixture
def endless(session, tiny_scene, tmp_path):
    """A training on two CPU processes that lasts longer than anybody waits, once it has written a checkpoint."""
    options = {
        "--machine.num-devices": 2,
        "--machine.device-type": "cpu",
        "--steps-per-save": 10,
        "--pipeline.model.densification": "splatfacto,stop_split_at=0",
    }
    words = command_line("nrfgs", tiny_scene, tmp_path, 100_000, options)
    with session("-m", "nrfgs_lab.many_processes", *words) as process:
        until = time.monotonic() + WAIT
        while not list(tmp_path.rglob("*.ckpt")) and process.poll() is None and time.monotonic() < until:
            time.sleep(0.1)
        yield process


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("to_all", [True, False])
def test_a_signal_stops_all_devices_with_one_checkpoint(to_all, endless, tmp_path):
    """From the terminal, which all processes hear, and sent to the second device alone."""
    if to_all:
        os.killpg(endless.pid, signal.SIGINT)
    else:
        os.kill(workers(endless.pid)[1], signal.SIGTERM)
    said, _ = endless.communicate(timeout=WAIT)
    assert endless.returncode == (0 if to_all else 143), said
    assert said.count("Stopped at step") == 1 and "Traceback" not in said, said
    (folder,) = tmp_path.rglob("nerfstudio_models")
    _, content = read_latest(folder)
    assert f"Stopped at step {content['step']}, saved. Go on with the same command and --load-dir {folder}" in said
    assert len(content["pipeline"]["_model.gauss_params.means"]) == 300


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_others_and_leaves_the_checkpoint(victim, endless, tmp_path):
    ranks = workers(endless.pid)
    os.kill(ranks[victim], signal.SIGKILL)
    said, _ = endless.communicate(timeout=WAIT)  # which returns: nobody waits for a dead process
    assert endless.returncode == 1 and len(ranks) == 2
    said = said[said.index("Training stopped") :]
    assert said.startswith(f"Training stopped: the process of device {victim} of 2 was killed by SIGKILL.")
    assert "Traceback" not in said
    for pid in ranks:
        assert not Path(f"/proc/{pid}").exists(), "a process was left behind"
    (folder,) = tmp_path.rglob("nerfstudio_models")
    path, content = read_latest(folder)
    assert str(path) in said
    assert len(content["pipeline"]["_model.gauss_params.means"]) == 300
