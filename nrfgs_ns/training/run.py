# SPDX-License-Identifier: Apache-2.0
"""One training and its evaluation, exactly as `ns-train` and `ns-eval` do them, with a record of what they cost."""

import hashlib
import json
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import profiler

import nrfgs_ns


@dataclass
class TrainRecord:
    """What one training cost."""

    args: list[str]
    """the command, after `ns-train`"""
    config_path: str
    """the config.yml that it saved"""
    steps: int = 0
    """training steps that were run"""
    seconds: float = 0.0
    """wall-clock of those steps, warm-up included, loading of images and start-up excluded"""
    peak_memory_bytes: int | None = None
    """most GPU memory in tensors; None on a CPU"""
    splats: list[list[int]] = field(default_factory=list)
    """pairs (step, number of splats), every hundredth step and the last"""
    saved: list[list[float]] = field(default_factory=list)
    """pairs (step, seconds until then) of the checkpoints"""
    parts: int = 1
    """processes that it took: more than one if it was interrupted and went on from a checkpoint"""


def parse(args: list[str]) -> TrainerConfig:
    """The configuration that `ns-train ARGS` would run."""
    config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
    if config.data:
        config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    return config


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
        earlier: the record until the checkpoint that `args` continue from; the result is that of the whole training.
    """
    config = parse(args)
    config.save_config()
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    model = trainer.pipeline.model
    record = TrainRecord(args, str(config.get_base_dir() / "config.yml"))
    if earlier is not None:
        record.steps, record.seconds, record.parts = earlier.steps, earlier.seconds, earlier.parts + 1
        record.splats, record.saved = list(earlier.splats), list(earlier.saved)
        record.peak_memory_bytes = earlier.peak_memory_bytes
    last_step = record.steps + trainer.config.max_num_iterations
    clock = _Clock(record)

    def before(step: int) -> None:
        clock.start()

    def after(step: int) -> None:
        record.steps += 1
        last = record.steps == last_step
        if last:
            clock.stop()
        if last or step % 100 == 0:
            record.splats.append([step, int(model.num_points)])
        if on_step is not None:
            on_step(step)

    save = trainer.save_checkpoint

    def save_off_the_clock(step: int) -> None:
        clock.stop()
        record.saved.append([step, record.seconds])
        if torch.cuda.is_available():
            record.peak_memory_bytes = max(record.peak_memory_bytes or 0, torch.cuda.max_memory_allocated())
        if on_save is not None:
            on_save(record)
        save(step)

    # Ahead of the model's own callbacks and behind them: its warm-up and its densification are on the clock.
    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before))
    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
    trainer.save_checkpoint = save_off_the_clock
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    profiler.flush_profiler(config.logging)
    return record


class _Clock:
    """Adds to `record.seconds` from each start to the next stop, when the GPU has finished; twice is once."""

    def __init__(self, record: TrainRecord):
        self.record = record
        self.started: float | None = None

    def start(self) -> None:
        if self.started is None:
            _synchronize()
            self.started = perf_counter()

    def stop(self) -> None:
        if self.started is not None:
            _synchronize()
            self.record.seconds += perf_counter() - self.started
            self.started = None


def evaluate(config_path: Path, output_path: Path, pictures: Path | None = None) -> dict[str, Any]:
    """Run `ns-eval --load-config CONFIG_PATH --output-path OUTPUT_PATH` in this process; returns its results.

    Args:
        pictures: folder for its pictures of the test views, if they are wanted (--render-output-path).
    """
    ComputePSNR(Path(config_path), Path(output_path), pictures).main()
    results = json.loads(Path(output_path).read_text())["results"]
    return {name: None if value != value else value for name, value in results.items()}  # NaN is no number: null


def machine() -> dict[str, str]:
    """What the numbers were taken on, and with which source."""
    return {
        "device": torch.cuda.get_device_name()
        if torch.cuda.is_available()
        else f"{torch.get_num_threads()} CPU threads",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "source": source_digest(),
    }


def source_digest() -> str:
    """Twelve hexadecimal digits that tell versions of this package's Python files apart.

    Unlike a commit they are there for an installed package too, and see what was not committed. Of a commit:
    `git archive COMMIT nrfgs_ns | tar x -C EMPTY`, and this function with EMPTY/nrfgs_ns.
    """
    return digest_of(Path(nrfgs_ns.__file__).parent)


def digest_of(package: Path) -> str:
    """`source_digest` of a package's folder: of names and contents, lines ending as Python reads them."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py"), key=lambda file: file.relative_to(package).as_posix()):
        for part in (file.relative_to(package).as_posix(), file.read_text(encoding="utf-8")):
            digest.update(f"{len(part)} {part}".encode())
    return digest.hexdigest()[:12]


def _synchronize() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
