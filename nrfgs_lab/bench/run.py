# SPDX-License-Identifier: Apache-2.0
"""One run of a benchmark, in a process of its own: train, `ns-eval`, measure, leave a record.

    python -m nrfgs_lab.bench.run JOB.json

It may be killed at any time and started again. What is finished is not repeated; a training goes on from its last
checkpoint if that was made with the same arguments. Two processes never work on the same run.
"""

import contextlib
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

from nrfgs_lab.bench.spec import Job
from nrfgs_lab.lock import only_one
from nrfgs_lab.run import host_without_downloads
from nrfgs_ns.files import write_whole
from nrfgs_ns.training.run import TrainRecord, evaluate, machine, train

PROGRESS_SECONDS = 1.0
"""Time between two notes of how far a training is."""


def run(job: Job) -> None:
    """Do the job, or what is left of it."""
    work, record_path = Path(job.work), Path(job.record)
    work.mkdir(parents=True, exist_ok=True)
    # A benchmark that was killed may have left its children behind: the next one must not train into their folders.
    with only_one(work / "lock", "Another process works on this run; waiting for it to end."):
        if record_path.exists():
            return
        forget_other_arguments(work, job.identity)
        start = perf_counter()
        with host_without_downloads(job.args[0]):
            from nrfgs_lab.bench.measure import measure

            record = train_or_continue(job, work)
            config = Path(record.config_path)
            results = evaluate(config, work / "eval.json", work / "pictures")
            measured = measure(config, job.train_views, timed=job.jobs == 1)
        content = {
            "identity": job.identity,
            "machine": machine(),
            "jobs": job.jobs,
            "wall_seconds": perf_counter() - start,
            "train": {
                **asdict(record),
                "args": job.identity["options"],
                "config_path": config.relative_to(work).as_posix(),
            },
            "eval": results,
            "measured": measured,
        }
        write_whole(record_path, json.dumps(content, indent=1) + "\n")


def train_or_continue(job: Job, work: Path) -> TrainRecord:
    """Train from the last checkpoint, or from the start.

    Only this project's methods continue: nerfstudio's own splatfacto loses its optimisers' hold of the parameters when
    it loads a checkpoint, and may leave a torn one.
    """

    def saved(record: TrainRecord) -> None:
        write_whole(work / "train.json", json.dumps(asdict(record)))

    noted = perf_counter()

    def stepped(step: int) -> None:
        nonlocal noted
        if perf_counter() - noted >= PROGRESS_SECONDS:
            with contextlib.suppress(OSError):  # a note that cannot be written is no reason to end a training
                write_whole(work / "progress.json", json.dumps({"step": step}))
            noted = perf_counter()

    args, earlier = job.args, None
    checkpoint = last_checkpoint(work) if args[0].startswith("nrfgs") else None
    if checkpoint is not None:
        earlier = record_until(work / "train.json", checkpoint)
    if earlier is not None:
        if earlier.steps >= job.steps:
            return earlier
        print(f"Going on from {checkpoint}")
        args = [args[0], "--load-dir", str(checkpoint.parent), *args[1:]]
    return train(args, stepped, saved, earlier)


def last_checkpoint(work: Path) -> Path | None:
    """The checkpoint of the latest step anywhere below a folder."""
    found = work.rglob("nerfstudio_models/step-*.ckpt")
    return max(found, key=lambda path: (path.name, path.stat().st_mtime), default=None)


def record_until(path: Path, checkpoint: Path) -> TrainRecord | None:
    """The training's record as it was when a checkpoint was saved; None if there is none that can be read."""
    try:
        record = TrainRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (FileNotFoundError, ValueError, TypeError):  # an earlier version's has other fields
        return None
    step = int(checkpoint.stem.split("-")[1])
    seconds = [seconds for at, seconds in record.saved if at == step]
    if not seconds:
        return None
    record.steps, record.seconds = step + 1, seconds[-1]
    record.saved = [pair for pair in record.saved if pair[0] <= step]
    record.splats = [pair for pair in record.splats if pair[0] <= step]
    record.config_path = str(checkpoint.parent.parent / "config.yml")
    return record


def forget_other_arguments(work: Path, identity: dict[str, Any]) -> None:
    """Clear a work folder that belongs to other arguments, so that nothing of theirs is continued."""
    note = work / "identity.json"
    with contextlib.suppress(FileNotFoundError, ValueError):
        if json.loads(note.read_text(encoding="utf-8")) == identity:
            return
    for path in work.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "lock":
            path.unlink()
    write_whole(note, json.dumps(identity))


def main(argv: list[str] | None = None) -> Any:
    run(Job(**json.loads(Path((argv or sys.argv[1:])[0]).read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
