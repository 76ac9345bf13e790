# SPDX-License-Identifier: Apache-2.0
"""One run of a benchmark: what is continued after a kill, what is only evaluated, what starts anew."""

import json
from pathlib import Path

import pytest

from nrfgs_lab.bench import run as bench_run
from nrfgs_lab.bench.run import forget_other_arguments, last_checkpoint, record_until, train_or_continue
from nrfgs_lab.bench.spec import Job
from nrfgs_ns.files import write_whole
from nrfgs_ns.training.run import TrainRecord


def job_in(folder: Path, method="nrfgs", steps=100) -> Job:
    args = [method, "--output-dir", str(folder), "--max-num-iterations", str(steps), "nrfgs-data", "--data", "x"]
    return Job(args, {"options": args[:1]}, steps, str(folder / "record.json"), str(folder), 0, 1)


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
        bench_run, "train", lambda args, stepped, saved, earlier: calls.append((args, earlier)) or TrainRecord(args, "")
    )
    return calls


def test_a_training_goes_on_from_its_last_checkpoint(tmp_path, trained):
    interrupted(tmp_path, 20, 40, reached=60)
    train_or_continue(job_in(tmp_path), tmp_path)
    ((args, earlier),) = trained
    models = tmp_path / "scene/nrfgs/2000-01-01/nerfstudio_models"
    assert args[:3] == ["nrfgs", "--load-dir", str(models)]
    assert args[args.index("--max-num-iterations") + 1] == "100"
    assert (earlier.steps, earlier.seconds) == (41, 4.0)
    assert earlier.splats[-1] == [40, 50] and earlier.saved == [[20, 2.0], [40, 4.0]]


def test_the_record_fits_the_checkpoint_that_is_there(tmp_path):
    """The kill came after the note about a checkpoint and before the checkpoint."""
    interrupted(tmp_path, 20, reached=40)
    earlier = record_until(tmp_path / "train.json", last_checkpoint(tmp_path))
    assert (earlier.steps, earlier.seconds, earlier.splats[-1]) == (21, 2.0, [20, 30])
    assert earlier.saved == [[20, 2.0]]


def test_a_note_of_an_earlier_version_is_not_continued(tmp_path):
    interrupted(tmp_path, 20, reached=40)
    for text in ('{"other": 1}', "torn"):
        (tmp_path / "train.json").write_text(text)
        assert record_until(tmp_path / "train.json", last_checkpoint(tmp_path)) is None


def test_a_full_disk_ends_no_training_for_a_note_of_its_progress(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    def train(args, stepped, saved, earlier):
        stepped(1)
        return TrainRecord(args, "")

    monkeypatch.setattr(bench_run, "PROGRESS_SECONDS", 0.0)
    monkeypatch.setattr(bench_run, "write_whole", full)
    monkeypatch.setattr(bench_run, "train", train)
    assert train_or_continue(job_in(tmp_path), tmp_path).config_path == ""


def test_killed_in_the_middle_of_ns_eval(tmp_path, monkeypatch, trained):
    """The training is finished and some pictures are written; the next attempt evaluates, and trains no more."""
    job = job_in(tmp_path, steps=41)
    evaluated = []

    def evaluate(config, path, pictures):
        evaluated.append(config.relative_to(tmp_path).as_posix())
        if len(evaluated) == 1:
            raise KeyboardInterrupt
        return {"psnr": 20.0}

    forget_other_arguments(tmp_path, job.identity)
    interrupted(tmp_path, 40, reached=40)
    monkeypatch.setattr(bench_run, "evaluate", evaluate)
    monkeypatch.setattr("nrfgs_lab.bench.measure.measure", lambda config, views: {"test": {}})
    with pytest.raises(KeyboardInterrupt):
        bench_run.run(job)
    assert not Path(job.record).exists()
    bench_run.run(job)
    assert not trained and evaluated == ["scene/nrfgs/2000-01-01/config.yml"] * 2
    assert json.loads(Path(job.record).read_text())["train"]["steps"] == 41


def test_a_finished_training_is_only_evaluated(tmp_path, trained):
    interrupted(tmp_path, 20, 40, reached=60)
    record = train_or_continue(job_in(tmp_path, steps=41), tmp_path)
    assert not trained and record.steps == 41
    assert record.config_path == str(tmp_path / "scene/nrfgs/2000-01-01/config.yml")


@pytest.mark.parametrize("method, checkpoints", [("nrfgs", []), ("splatfacto", [20, 40]), ("nrfgs", [33])])
def test_what_cannot_be_continued_starts_anew(method, checkpoints, tmp_path, trained):
    """No checkpoint; a method that cannot resume; a checkpoint of which nothing is noted."""
    interrupted(tmp_path, *checkpoints, reached=60)
    job = job_in(tmp_path, method)
    train_or_continue(job, tmp_path)
    assert trained == [(job.args, None)]


def test_checkpoints_of_other_arguments_are_cleared(tmp_path):
    forget_other_arguments(tmp_path, {"options": ["a"]})
    interrupted(tmp_path, 20, reached=20)
    forget_other_arguments(tmp_path, {"options": ["a"]})
    assert last_checkpoint(tmp_path) is not None
    forget_other_arguments(tmp_path, {"options": ["b"]})
    assert last_checkpoint(tmp_path) is None and not (tmp_path / "train.json").exists()


def test_a_finished_run_is_not_repeated_by_a_late_child(tmp_path, trained):
    job = job_in(tmp_path)
    Path(job.record).write_text("{}")
    bench_run.run(job)
    assert not trained and Path(job.record).read_text() == "{}"
