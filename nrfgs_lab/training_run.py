# SPDX-License-Identifier: Apache-2.0
"""One training and its evaluation, exactly as `ns-train` and `ns-eval` do them, with a record of their cost."""

import hashlib
import json
import platform
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import profiler
from nerfstudio.utils.misc import step_check

import nrfgs_ns


@dataclass
class TrainRecord:
    """Cost of one training."""

    args: list[str]  # the command, after `ns-train`
    config_path: str
    steps: int = 0  # completed steps
    seconds: float = 0.0  # wall-clock of those steps, warm-up included, loading of images and start-up excluded
    peak_memory_bytes: int | None = None  # most GPU memory in tensors; None on a CPU
    splats: list[list[int]] = field(default_factory=list)
    """pairs (step, number of splats), every hundredth step and the last"""
    saved: list[list[float]] = field(default_factory=list)  # pairs (step, seconds until then) of the checkpoints
    parts: int = 1  # number of processes: more than one if it was interrupted and went on from a checkpoint


def parse(args: list[str]) -> TrainerConfig:
    """The configuration that `ns-train ARGS` would run."""
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion  # after our methods

    config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
    if config.data:
        config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    return config


def set_up(config: TrainerConfig, rank: int = 0, world: int = 1) -> Trainer:
    """A trainer before its first step, with the seed that ns-train sets; `rank` of a `world` of devices."""
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=rank, world_size=world)
    trainer.setup()
    return trainer


def train(
    args: list[str],
    on_step: Callable[[int], None] | None = None,
    on_save: Callable[[TrainRecord], None] | None = None,
    earlier: TrainRecord | None = None,
) -> TrainRecord:
    """Run `ns-train ARGS` in this process.

    Args:
        on_step: called after each step with its number, for progress bars.
        on_save: called before each checkpoint is written, with the record of the training until then.
        earlier: the record until the checkpoint that `args` continue from; the result is the whole training's.
    """
    config = parse(args)
    config.save_config()
    trainer = set_up(config)
    model, path = trainer.pipeline.model, str(config.get_base_dir() / "config.yml")
    record = TrainRecord(args, path)
    if earlier is not None:
        record = replace(deepcopy(earlier), args=args, config_path=path, parts=earlier.parts + 1)
    last_step = record.steps + trainer.config.max_num_iterations
    started: float | None = None

    def before(step: int) -> None:
        nonlocal started
        if started is None:
            synchronize()
            started = perf_counter()

    def after(step: int) -> None:
        nonlocal started
        record.steps += 1
        is_last = record.steps == last_step or trainer.stop_training
        if is_last or step % 100 == 0:
            record.splats.append([step, int(model.num_points)])
        if is_last or step_check(step, config.steps_per_save):  # a checkpoint follows, off the clock
            synchronize()
            record.seconds += perf_counter() - started
            started = None
            record.saved.append([step, record.seconds])
            if torch.cuda.is_available():
                record.peak_memory_bytes = max(record.peak_memory_bytes or 0, torch.cuda.max_memory_allocated())
            if on_save is not None:
                on_save(record)
        if on_step is not None:
            on_step(step)

    # Around the model's own callbacks: its warm-up and its densification are on the clock.
    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before))
    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    profiler.flush_profiler(config.logging)
    return record


def evaluate(config_path: Path, output_path: Path, pictures: Path | None = None) -> dict[str, Any]:
    """Run `ns-eval --load-config CONFIG_PATH --output-path OUTPUT_PATH` in this process; returns its results. With a
    folder for pictures of the test views it writes them (--render-output-path)."""
    ComputePSNR(Path(config_path), Path(output_path), pictures).main()
    results = json.loads(Path(output_path).read_text())["results"]
    return {name: None if value != value else value for name, value in results.items()}  # NaN is no number: null


def machine() -> dict[str, str]:
    """Device, versions and source of a measurement."""
    cuda = torch.cuda.is_available()
    return {
        "device": torch.cuda.get_device_name() if cuda else f"{torch.get_num_threads()} CPU threads",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "source": digest_of(Path(nrfgs_ns.__file__).parent),
    }


def digest_of(package: Path) -> str:
    """Twelve hexadecimal digits that identify the names and contents of a package's Python files, uncommitted ones too.
    Those of a commit: `git archive COMMIT nrfgs_ns | tar x -C EMPTY`, and `digest_of(EMPTY/nrfgs_ns)`."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py"), key=lambda file: file.relative_to(package).as_posix()):
        for part in (file.relative_to(package).as_posix(), file.read_text(encoding="utf-8")):
            digest.update(f"{len(part)} {part}".encode())
    return digest.hexdigest()[:12]


def synchronize() -> None:
    """Wait for the GPU, if there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
