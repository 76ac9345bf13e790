# SPDX-License-Identifier: Apache-2.0
"""One run of a benchmark: what is continued after a kill, only evaluated, or begun anew; where it runs."""

import json
from pathlib import Path

import pytest

from nrfgs_lab.bench import run as bench_run
from nrfgs_lab.bench.job import Job
from nrfgs_lab.bench.run import forget_other_arguments, last_checkpoint, record_until, train_or_continue
from nrfgs_lab.training_run import TrainRecord
from nrfgs_ns.files import write_whole


def job_in(folder: Path, method="nrfgs", steps=100) -> Job:
    args = [method, "--output-dir", str(folder), "--max-num-iterations", str(steps), "nrfgs-data", "--data", "x"]
    return Job(args, {}, {"options": args[:1]}, steps, str(folder / "record.json"), str(folder), 0, 1)


def interrupted(folder: Path, *checkpoints: int, reached: int) -> None:
    """The work folder of a training that was killed after step `reached`."""
    models = folder / "scene" / "nrfgs" / "2000-01-01" / "nerfstudio_models"
    models.mkdir(parents=True)
    for step in checkpoints:
        (models / f"step-{step:09d}.ckpt").write_bytes(b"")
    splats = [[step, 10 + step] for step in range(0, reached + 1, 10)]
    record = TrainRecord(
        ["nrfgs"], "lost", steps=reached + 1, seconds=99.0, splats=splats, saved=[[20, 2.0], [40, 4.0]]
    )
    write_whole(folder / "train.json", json.dumps(record.__dict__))


@pytest.fixture
def trained(monkeypatch):
    """Calls of a train() that does nothing."""
    calls = []
    monkeypatch.setattr(
        bench_run, "train", lambda args, on_save, earlier: calls.append((args, earlier)) or TrainRecord(args, "")
    )
    return calls


def test_the_record_fits_the_checkpoint_that_is_there(tmp_path):
    """The kill came after the note about a checkpoint and before the checkpoint."""
    interrupted(tmp_path, 20, reached=40)
    earlier = record_until(tmp_path / "train.json", last_checkpoint(tmp_path))
    assert (earlier.steps, earlier.seconds, earlier.splats[-1]) == (21, 2.0, [20, 30])
    assert earlier.saved == [[20, 2.0]]


@pytest.mark.parametrize(
    "method, steps, checkpoints",
    [("nrfgs", 100, []), ("splatfacto", 100, [20, 40]), ("nrfgs", 100, [33]), ("nrfgs", None, [20])],
)
def test_what_cannot_be_continued_starts_anew(method, steps, checkpoints, tmp_path, trained):
    """No checkpoint; a method that cannot resume; a checkpoint without a note; steps that the method chooses."""
    interrupted(tmp_path, *checkpoints, reached=60)
    job = job_in(tmp_path, method, steps)
    train_or_continue(job, tmp_path)
    assert trained == [(job.args, None)]


def test_checkpoints_of_other_arguments_are_cleared(tmp_path):
    forget_other_arguments(tmp_path, {"options": ["a"]})
    interrupted(tmp_path, 20, reached=20)
    forget_other_arguments(tmp_path, {"options": ["a"]})
    assert last_checkpoint(tmp_path) is not None
    forget_other_arguments(tmp_path, {"options": ["b"]})
    assert last_checkpoint(tmp_path) is None and not (tmp_path / "train.json").exists()
