# SPDX-License-Identifier: Apache-2.0
"""Runs as tasks of submitit, on this machine: the same records, resumed and merged like those of child processes."""

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("submitit")

from nrfgs_lab.bench import command as bench
from nrfgs_lab.bench import executor as bench_executor
from nrfgs_lab.bench.command import Bench
from nrfgs_lab.bench.executor import Queue, Submitted, Task
from nrfgs_ns.errors import InputError

CHILD = """
import json, os, sys
from pathlib import Path

job = json.loads(Path(sys.argv[1]).read_text())
print("working on", job["record"])
if Path(__file__).with_name("fail").exists() and "NRF" in job["record"]:
    sys.exit(3)
metrics = {"psnr": 20.0, "ssim": 0.9, "ms_ssim": None, "l1": 0.1, "lpips": None}
record = {
    "identity": job["identity"], "machine": {"device": "fake", "torch": "0"}, "jobs": job["jobs"], "wall_seconds": 1.0,
    "train": {"seconds": 10.0, "parts": 1, "splats": [[0, 10], [100, 20]]},
    "measured": {"test": metrics, "train": None, "fps": 5.0, "splats": 20, "parameter_bytes": 1, "checkpoint_bytes": 2},
}
Path(job["record"]).write_text(json.dumps(record))
with Path(__file__).with_name("ran.txt").open("a") as file:
    task, gpu = os.environ["SUBMITIT_LOCAL_JOB_ID"], os.environ["CUDA_VISIBLE_DEVICES"]
    file.write(f"{Path(job['record']).stem} {task} {gpu}\\n")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    (tmp_path / "child.py").write_text(CHILD)
    (tmp_path / "data" / "scene").mkdir(parents=True)
    (tmp_path / "data" / "scene" / "transforms.json").write_text("{}")
    monkeypatch.setattr(bench, "CHILD", (sys.executable, str(tmp_path / "child.py")))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7,9")
    return tmp_path


def bench_in(folder: Path, **more) -> Bench:
    options = {"data": ("scene",), "runs": ("SH=nrfgs-sh", "NRF=nrfgs"), "seeds": (1,), "steps": 100, **more}
    return Bench(scenes=folder / "data", out=folder / "out", work=folder / "work", executor="local", gpus=2, **options)


def ran(folder: Path) -> list[list[str]]:
    """run, task and GPU of each command that came to its end."""
    return sorted(line.split() for line in (folder / "ran.txt").read_text().splitlines())


def test_one_task_a_run_resumed_and_merged(folder):
    """A run fails and is tried again alone; the table has both."""
    (folder / "fail").touch()
    with pytest.raises(SystemExit, match="1 of the runs FAILED: NRF-own-scene-1"):
        bench_in(folder).main()
    assert [name for name, *_ in ran(folder)] == ["SH-own-scene-1"]
    assert json.loads((folder / "out/runs/NRF-own-scene-1.failed").read_text())["returncode"] == 1
    assert "working on" in (folder / "work" / "NRF-own-scene-1.log").read_text()
    assert "| scene | NRF | own | 0 (1 FAILED) |" in (folder / "out" / "table.md").read_text()
    (folder / "fail").unlink()
    bench_in(folder).main()
    names, tasks, gpus = zip(*ran(folder), strict=True)
    assert names == ("NRF-own-scene-1", "SH-own-scene-1")
    assert len(set(tasks)) == 2, "two runs in one task"
    assert set(gpus) <= {"7", "9"}
    table = (folder / "out" / "table.md").read_text()
    assert "| scene | NRF | own | 1 |" in table and "| scene | SH | own | 1 |" in table


def test_an_interrupted_task_is_the_same_command_again(tmp_path):
    task = Task([sys.executable, "-c", "import time; time.sleep(60)"], str(tmp_path / "log"))
    again = task.checkpoint()
    assert again.function.command == task.command and again.function.log == task.log


class Elsewhere:
    """A task in a queue, as submitit shows it."""

    def __init__(self, folder, job_id):
        self.job_id = job_id

    def done(self, force_check=False):
        return self.job_id == "gone"

    def cancel(self):
        raise AssertionError("a task in a queue outlives the benchmark")


def test_a_task_that_still_waits_in_the_queue_is_not_handed_in_again(tmp_path, monkeypatch):
    monkeypatch.setattr("submitit.SlurmJob", Elsewhere)
    queue = Queue.__new__(Queue)
    queue.name, queue.folder = "slurm", tmp_path
    note = tmp_path / "note.json"
    for told, found in (("waiting", True), ("gone", False)):
        note.write_text(json.dumps({"executor": "slurm", "job": told}))
        assert (queue._earlier(note) is not None) == found
    note.write_text(json.dumps({"executor": "local", "job": "waiting"}))
    assert queue._earlier(note) is None
    submitted = Submitted(Elsewhere(tmp_path, "waiting"), lives_on=True)
    submitted.terminate()
    submitted.wait()
    assert submitted.poll() is None


@pytest.mark.parametrize("parameter, says", [("partition", "KEY=VALUE"), ("colour=red", "colour")])
def test_parameters_that_cannot_be_are_named(tmp_path, monkeypatch, parameter, says):
    with pytest.raises(InputError, match=says):
        Queue("local", tmp_path, (parameter,))


def test_without_submitit_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(InputError, match="cluster"):
        bench_executor.Queue("local", tmp_path)
