# SPDX-License-Identifier: Apache-2.0
"""One training of a benchmark, in a process of its own: train, `ns-eval`, measure, leave a record.

    python -m nrfgs_lab.bench.run JOB.json

It may be killed at any time and started again: finished parts are skipped, and a training resumes from its last
checkpoint if the arguments are the same. Two processes never work on the same training.
"""

import contextlib
import json
import shutil
import sys
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any
from unittest import mock

import torch
from filelock import FileLock

from nrfgs_lab.bench.job import Job
from nrfgs_lab.bench.measure import measure
from nrfgs_lab.bench.spec import is_ours
from nrfgs_lab.training_run import TrainRecord, evaluate, machine, train
from nrfgs_ns.files import write_whole
from nrfgs_ns.training.checkpoint_files import allow_nerfstudio_checkpoints


def run(job: Job) -> None:
    """Do a job, or the rest of it."""
    work, record_path = Path(job.work), Path(job.record)
    work.mkdir(parents=True, exist_ok=True)
    # A killed benchmark may leave children behind, which train into this folder.
    with FileLock(work / "lock"):
        if record_path.exists():
            return
        forget_other_arguments(work, job.identity)
        start = perf_counter()
        with host_without_downloads(job.args[0]):
            record = train_or_continue(job, work)
            config = Path(record.config_path)
            results = {} if job.quick else {"eval": evaluate(config, work / "eval.json", work / "pictures")}
            measured = measure(config, job.train_views, timed=job.jobs == 1 and not job.quick)
        content = {
            "cell": job.cell,
            "identity": job.identity,
            "machine": machine(),
            "jobs": job.jobs,
            "wall_seconds": perf_counter() - start,
            "train": {
                **asdict(record),
                "args": job.identity["options"],
                "config_path": config.relative_to(work).as_posix(),
            },
            **results,
            "measured": measured,
        }
        write_whole(record_path, json.dumps(content, indent=1) + "\n")
        if job.quick:
            shutil.rmtree(work, ignore_errors=True)


def host_without_downloads(method: str) -> AbstractContextManager:
    """Let nerfstudio's own methods run offline within a block, for comparisons.

    They build LPIPS with the model and download its weights: it is replaced by one that returns NaN, unless the weights
    are on disk. torch must be allowed to read their checkpoints.
    """
    from torchvision.models import AlexNet_Weights

    allow_nerfstudio_checkpoints()
    weights = Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.DEFAULT.url).name
    if is_ours(method) or weights.is_file():
        return contextlib.nullcontext()
    lpips = "torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity"
    return mock.patch(lpips, lambda **_: lambda *_: torch.tensor(float("nan")))


def train_or_continue(job: Job, work: Path) -> TrainRecord:
    """Train from the last checkpoint, or from the start.

    Only this project's methods with a given number of steps resume: splatfacto's optimisers lose its parameters when it
    loads a checkpoint, and the checkpoint may be torn.
    """

    def saved(record: TrainRecord) -> None:
        write_whole(work / "train.json", json.dumps(asdict(record)))

    args = job.args
    checkpoint = last_checkpoint(work) if is_ours(args[0]) and job.steps else None
    earlier = checkpoint and record_until(work / "train.json", checkpoint)
    if earlier is not None:
        if earlier.steps >= job.steps:
            return earlier
        print(f"Going on from {checkpoint}")
        args = [args[0], "--load-dir", str(checkpoint.parent), *args[1:]]
    return train(args, on_save=saved, earlier=earlier)


def last_checkpoint(work: Path) -> Path | None:
    """Checkpoint of the latest step below a folder."""
    files = work.rglob("nerfstudio_models/step-*.ckpt")
    return max(files, key=lambda path: (path.name, path.stat().st_mtime), default=None)


def record_until(path: Path, checkpoint: Path) -> TrainRecord | None:
    """Record of a training up to a checkpoint; None if it cannot be read or lacks the step."""
    try:
        record = TrainRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (FileNotFoundError, ValueError):
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
    """Clear a work folder of other arguments."""
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


if __name__ == "__main__":
    run(Job(**json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
