# SPDX-License-Identifier: Apache-2.0
"""One run of a benchmark: what is continued after a kill, only evaluated, or begun anew; where it runs."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

import nrfgs_ns
from nrfgs_lab.bench import run as bench_run
from nrfgs_lab.bench.run import forget_other_arguments, last_checkpoint, record_until, train_or_continue
from nrfgs_lab.bench.spec import Job
from nrfgs_lab.training_run import TrainRecord, digest_of, machine
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


def test_a_quick_run_leaves_its_record_alone(tmp_path, monkeypatch, trained):
    """No ns-eval, no frame rates, no files."""
    measured = []
    measure = "nrfgs_lab.bench.run.measure"
    monkeypatch.setattr(measure, lambda config, views, timed: measured.append(timed) or {"test": {}})
    job = job_in(tmp_path / "work", steps=41)
    job.record, job.quick = str(tmp_path / "record.json"), True
    (tmp_path / "work").mkdir()
    forget_other_arguments(tmp_path / "work", job.identity)
    interrupted(tmp_path / "work", 40, reached=40)
    bench_run.run(job)
    assert measured == [False] and "eval" not in json.loads(Path(job.record).read_text())
    assert not (tmp_path / "work").exists()


def test_a_finished_run_is_not_repeated_by_a_late_child(tmp_path, trained):
    job = job_in(tmp_path)
    Path(job.record).write_text("{}")
    bench_run.run(job)
    assert not trained and Path(job.record).read_text() == "{}"


SPEC = """
runs: {NRF: nrfgs}
strategies: ['mcmc@400,warmup_length=10,refine_every=10']
scenes: [tiny]
seeds: [1]
steps: 120
checkpoint_every: 20
train_views: 3
options: --pipeline.model.num-downscales 0
"""


@pytest.mark.slow
def test_killed_in_the_middle_and_resumed(tiny_scene, tmp_path):
    (tmp_path / "spec.yaml").write_text(SPEC)
    command = [sys.executable, "-m", "nrfgs_ns.cli", "bench", str(tmp_path / "spec.yaml")]
    command += ["--scenes", str(tiny_scene.parent), "--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True)
    while not list((tmp_path / "work").rglob("nerfstudio_models/step-0000000[4-9]*.ckpt")):
        assert first.poll() is None
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGKILL)  # the benchmark and its child, as when a machine goes down
    first.wait()
    assert not list((tmp_path / "out" / "runs").iterdir())

    subprocess.run(command, check=True)
    (record,) = (json.loads(file.read_text()) for file in (tmp_path / "out" / "runs").glob("*.json"))
    assert record["train"]["parts"] == 2 and record["train"]["steps"] == 120
    steps = [step for step, _ in record["train"]["splats"]]
    assert steps == [0, 100, 119], "the resumed training must count on where it was cut off"
    assert record["measured"]["splats"] == 400 and len(record["measured"]["train"]["per_image"]) == 3
    assert str(tmp_path) not in json.dumps(record), "a record must not name places"
    assert "interrupted" in (tmp_path / "out" / "table.md").read_text()
    assert Image.open(tmp_path / "out" / "crops" / "tiny.png").width > 2 * 220


def test_the_digest_is_of_names_and_contents(tmp_path):
    def digest(files: dict[str, bytes]) -> str:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return digest_of(folder)

    files = {"a.py": b"x = 1\n", "part/b.py": b""}
    same = {**files, "part/c.txt": b"notes"}, {**files, "a.py": b"x = 1\r\n"}
    others = {**files, "a.py": b"x = 2\n"}, {**files, "c.py": b""}, {"a.py": b"", "part/b.py": b"x = 1\n"}
    assert {digest(each) for each in same} == {digest(files)}
    assert digest(files) not in [digest(each) for each in others]
    assert machine()["source"] == digest_of(Path(nrfgs_ns.__file__).parent)
