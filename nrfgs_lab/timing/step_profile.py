# SPDX-License-Identifier: Apache-2.0
"""Where the time of one training step goes: kernels, launches, waits and the host, method by method.

    python -m nrfgs_lab.timing.step_profile --scene SCENES/bonsai --splats 300000 --out step_profile.json

Each method trains for a few hundred steps at full resolution from the same number of random splats, densification
off, as `ns-train` would run it. Wall-clock is taken over steps that nothing watches; then the same steps are timed
section by section on the host (no waiting added, so a section that waits for the GPU shows its wait), and a last few
are traced with torch's profiler for kernels. Methods take turns within a round, so that a drifting machine hurts all
alike.
"""

import contextlib
import json
import statistics
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed
from rich.console import Console
from rich.table import Table
from torch.profiler import ProfilerActivity, profile

from nrfgs_lab.run import host_without_downloads
from nrfgs_ns.training.run import machine, parse

WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize", "cudaMemcpyAsync")


@dataclass
class StepProfile:
    """Which methods, on how many splats."""

    scene: Path
    """folder of a data set in nerfstudio's layout"""
    out: Path
    """JSON file of the results"""
    methods: tuple[str, ...] = ("splatfacto", "nrfgs-sh", "nrfgs")
    """methods, each NAME or NAME:LABEL=OPTIONS"""
    splats: tuple[int, ...] = (300_000,)
    """numbers of splats"""
    extent: float = 1.0
    """side of the cube that the splats fill, in scene units"""
    steps: int = 200
    """steps in each timed stretch"""
    warm: int = 300
    """steps before the first: as many as there are training images, whose first use costs more"""
    traced: int = 20
    """steps under torch's profiler"""
    rounds: int = 2
    """turns of each method"""

    def main(self) -> None:
        rows: list[dict[str, Any]] = []
        for count in self.splats:
            for turn in range(self.rounds):
                for method in self.methods:
                    rows.append({"splats": count, "round": turn, **self.measure(method, count)})
                    print(rows[-1]["method"], count, f"{rows[-1]['step_ms']:.2f} ms", file=sys.stderr)
                    self.out.parent.mkdir(parents=True, exist_ok=True)
                    self.out.write_text(json.dumps({"machine": machine(), "runs": rows}, indent=1) + "\n")
        report(rows)

    def measure(self, method: str, count: int) -> dict[str, Any]:
        """Train `method` on `count` splats and watch it."""
        label, _, options = method.partition("=")
        name = label.partition(":")[0]
        warm, end = self.warm, self.warm + 2 * self.steps + self.traced
        args = [name, "--max-num-iterations", str(end + 1), "--vis", "tensorboard", "--steps-per-save", "1000000"]
        args += ["--steps-per-eval-image", "1000000", "--steps-per-eval-all-images", "1000000"]
        args += ["--logging.local-writer.enable", "False", "--logging.profiler", "none"]
        args += ["--pipeline.model.random-init", "True", "--pipeline.model.num-random", str(count)]
        args += ["--pipeline.model.random-scale", str(self.extent), "--pipeline.model.num-downscales", "0"]
        args += ["--pipeline.model.warmup-length", "1000000", *options.split(), "nrfgs-data", "--data", str(self.scene)]
        folder = tempfile.mkdtemp()  # left behind: tensorboard's thread writes to it until the process ends
        with host_without_downloads(name):
            config = parse([name, "--output-dir", folder, *args[1:]])
            config.save_config()
            _set_random_seed(config.machine.seed)
            trainer = config.setup(local_rank=0, world_size=1)
            trainer.setup()
            clock = Clock()
            watch = profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA])
            wall: list[float] = []

            def after(step: int) -> None:
                if step in (warm, warm + self.steps):
                    synchronize()
                    wall.append(perf_counter())
                if step == warm + self.steps:
                    clock.attach(trainer)
                if step == warm + 2 * self.steps:
                    clock.detach()
                    watch.start()
                if step == end:
                    synchronize()
                    watch.stop()

            trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
            peak = torch.cuda.reset_peak_memory_stats() if torch.cuda.is_available() else None
            with contextlib.redirect_stdout(sys.stderr):
                trainer.train()
            peak = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else peak
        return {
            "method": label,
            "step_ms": 1e3 * (wall[1] - wall[0]) / self.steps,
            "peak_memory_bytes": peak,
            "host_ms": {name: 1e3 * seconds / self.steps for name, seconds in clock.seconds.items()},
            **kernels(watch, self.traced),
        }


class Clock:
    """Host time of the parts of nerfstudio's training step, by wrapping the objects' own methods."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._undo: list[Callable[[], None]] = []

    def attach(self, trainer: Any) -> None:
        """Start timing."""
        model, optimizers = trainer.pipeline.model, trainer.optimizers
        self._wrap(trainer.pipeline.datamanager, "next_train", "data")
        self._wrap(model, "get_outputs", "forward")
        self._wrap(model, "get_metrics_dict", "metrics")
        self._wrap(model, "get_loss_dict", "loss")
        self._wrap(torch.Tensor, "backward", "backward")
        self._wrap(optimizers, "zero_grad_some", "zero_grad")
        self._wrap(optimizers, "optimizer_scaler_step_some", "optimizers")
        self._wrap(optimizers, "optimizer_scaler_step_all", "optimizers")
        self._wrap(optimizers, "scheduler_step_all", "schedulers")
        self._wrap(trainer, "train_iteration", "train_iteration, all")
        for callback in trainer.callbacks[:-1]:
            self._wrap(callback, "run_callback_at_location", "callbacks")

    def detach(self) -> None:
        """Stop timing, put the methods back."""
        for undo in reversed(self._undo):
            undo()

    def _wrap(self, owner: Any, name: str, section: str) -> None:
        original = getattr(owner, name)
        own = name in vars(owner)

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                self.seconds[section] += perf_counter() - start

        setattr(owner, name, timed)
        self._undo.append(lambda: setattr(owner, name, original) if own else delattr(owner, name))


def kernels(watch: profile, steps: int) -> dict[str, Any]:
    """Kernels, waits and host operations of the traced steps, each per step."""
    device = defaultdict(lambda: [0, 0.0])
    for event in watch.events():
        if event.device_type == torch.autograd.DeviceType.CUDA and not event.is_user_annotation:
            entry = device[event.name]
            entry[0] += 1
            entry[1] += event.device_time
    host = watch.key_averages()
    waits = {
        event.key: [event.count / steps, event.cpu_time_total / steps / 1e3] for event in host if event.key in WAITS
    }
    busiest = sorted(device.items(), key=lambda item: -item[1][1])
    operations = sorted(host, key=lambda event: -event.self_cpu_time_total)
    return {
        "gpu_ms": sum(time for _, time in device.values()) / steps / 1e3,
        "launches": sum(count for count, _ in device.values()) / steps,
        "waits": waits,
        "kernels": [[name[:120], count / steps, time / steps / 1e3] for name, (count, time) in busiest[:10]],
        "operations": [
            [event.key[:120], event.count / steps, event.self_cpu_time_total / steps / 1e3] for event in operations[:10]
        ],
    }


def report(rows: list[dict[str, Any]]) -> None:
    """Print the medians over rounds."""
    sections = list(dict.fromkeys(name for row in rows for name in row["host_ms"]))
    table = Table(*("splats", "method", "step ms", "GPU ms", "launches"), *sections)
    for key in dict.fromkeys((row["splats"], row["method"]) for row in rows):
        mine = [row for row in rows if (row["splats"], row["method"]) == key]
        cells = [statistics.median(row[name] for row in mine) for name in ("step_ms", "gpu_ms", "launches")]
        cells += [statistics.median(row["host_ms"].get(name, 0.0) for row in mine) for name in sections]
        table.add_row(f"{key[0]:,}", key[1], *(f"{cell:.2f}" for cell in cells))
    Console(width=200).print(table)


def synchronize() -> None:
    """Wait for the GPU, if there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    tyro.cli(StepProfile).main()
