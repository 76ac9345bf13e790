# SPDX-License-Identifier: Apache-2.0
"""One training and its evaluation, exactly as `ns-train` and `ns-eval` do them, with a record of what they cost.

    python -m nrfgs_ns.studies.run RECORD.json METHOD [options of ns-train]

trains METHOD (any method that nerfstudio knows, its own splatfacto included), evaluates the last checkpoint, and writes
everything measured to RECORD.json.
"""

import contextlib
import json
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
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
from torch import nn

from nrfgs_ns.checkpoint import allow_nerfstudio_checkpoints


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


def parse(args: list[str]) -> TrainerConfig:
    """The configuration that `ns-train ARGS` would run."""
    config = tyro.cli(AnnotatedBaseConfigUnion, args=args)
    if config.data:
        config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    return config


def train(args: list[str], on_step: Callable[[int], None] | None = None) -> TrainRecord:
    """Run `ns-train ARGS` in this process.

    Args:
        args: the command line after `ns-train`.
        on_step: called after each step with its number, for progress bars.
    """
    config = parse(args)
    config.save_config()
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    model = trainer.pipeline.model
    record = TrainRecord(args, str(config.get_base_dir() / "config.yml"))
    start = 0.0

    def before(step: int) -> None:
        nonlocal start
        if record.steps == 0:
            _synchronize()
            start = perf_counter()

    def after(step: int) -> None:
        record.steps += 1
        last = record.steps == config.max_num_iterations
        if last:
            _synchronize()
            record.seconds = perf_counter() - start
        if last or step % 100 == 0:
            record.splats.append([step, int(model.num_points)])
        if on_step is not None:
            on_step(step)

    # Ahead of the model's own callbacks and behind them: its warm-up and its densification are on the clock.
    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], before))
    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    profiler.flush_profiler(config.logging)
    if torch.cuda.is_available():
        record.peak_memory_bytes = torch.cuda.max_memory_allocated()
    return record


def evaluate(config_path: Path, output_path: Path) -> dict[str, Any]:
    """Run `ns-eval --load-config CONFIG_PATH --output-path OUTPUT_PATH` in this process; returns its results."""
    ComputePSNR(load_config=Path(config_path), output_path=Path(output_path)).main()
    results = json.loads(Path(output_path).read_text())["results"]
    return {name: None if value != value else value for name, value in results.items()}  # NaN is no number: null


@contextlib.contextmanager
def host_without_downloads(method: str) -> Iterator[None]:
    """Let nerfstudio's own methods run offline, for comparisons.

    They build LPIPS, and download its weights, with the model. For the time of a run it is replaced by one that gives
    NaN. Their checkpoints need torch's leave to be read. This project's methods need no such thing.
    """
    if method.startswith("nrfgs"):
        yield
        return
    allow_nerfstudio_checkpoints()
    import torchmetrics.image.lpip as lpip

    class NoLpips(nn.Module):
        def __init__(self, **_: Any):
            super().__init__()

        def forward(self, *_: Any) -> torch.Tensor:
            return torch.tensor(float("nan"))

    original, lpip.LearnedPerceptualImagePatchSimilarity = lpip.LearnedPerceptualImagePatchSimilarity, NoLpips
    try:
        yield
    finally:
        lpip.LearnedPerceptualImagePatchSimilarity = original


def machine() -> dict[str, str]:
    """What the numbers were taken on."""
    return {
        "device": torch.cuda.get_device_name()
        if torch.cuda.is_available()
        else f"{torch.get_num_threads()} CPU threads",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _synchronize() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def main() -> None:
    record_path, args = Path(sys.argv[1]), sys.argv[2:]
    with host_without_downloads(args[0]):
        record = train(args)
        results = evaluate(Path(record.config_path), record_path.with_suffix(".eval.json"))
    record_path.with_suffix(".eval.json").unlink()
    record_path.write_text(
        json.dumps({"method": args[0], "machine": machine(), "train": asdict(record), "eval": results}, indent=1)
    )


if __name__ == "__main__":
    main()
