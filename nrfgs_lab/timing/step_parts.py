# SPDX-License-Identifier: Apache-2.0
"""What each of the step's own kernels and its CUDA graph save, and how a step and a frame of methods compare.

    python -m nrfgs_lab.timing.step_parts --scene SCENES/bonsai --splats 250000 --out step_parts.json

Each method trains at full resolution until it has the splats, loses what are too many, and goes on without adding or
removing any. Then stretches of steps are timed in turns: with everything, and with each part closed, which leaves its
work to gsplat or PyTorch. What a step takes the host is the median over a stretch of its time without what the host has
waited for the GPU. A few steps of each variant are traced for the GPU's own time. At last all trained models
render the test views in turns, at the photographs' size and at 1080p. Methods take turns, too, `rounds` times.
"""

import contextlib
import gc
import json
import statistics
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed
from torch.profiler import ProfilerActivity, profile

from nrfgs_lab.bench.measure import FULL_HD, at_size, frames_per_second
from nrfgs_lab.bench.run import host_without_downloads
from nrfgs_ns.densification import statistics as growth
from nrfgs_ns.kernels.trial import Gate
from nrfgs_ns.rasterizer import gsplat_cuda
from nrfgs_ns.training import optimizers
from nrfgs_ns.training.guard import remove_splats
from nrfgs_ns.training.run import machine, parse

GATES: dict[str, Gate] = {"lists": gsplat_cuda._GATE, "adam": optimizers._GATE, "statistics": growth._GATE}
VARIANTS: dict[str, tuple[str, ...]] = {
    "whole": (),
    "without graph": ("graph",),
    "without graph, lists": ("graph", "lists"),
    "without graph, adam": ("graph", "adam"),
    "without graph, statistics": ("graph", "statistics"),
    "without all": ("graph", *GATES),
    "at rest: whole": (),
    "at rest: without graph": ("graph",),
    "at rest: without all": ("graph", *GATES),
}
"""Variants of a step -> the parts that are closed. At rest nothing is remembered for densification."""
NEVER = 10**9


@dataclass
class StepParts:
    """Which methods, on how many splats."""

    scene: Path
    """folder of a data set in nerfstudio's layout"""
    out: Path
    """JSON file of the results"""
    methods: tuple[str, ...] = ("nrfgs", "nrfgs-sh")
    """methods that densify as splatfacto does"""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """what is timed of a step"""
    splats: int = 250_000
    """of each method; fewer, if it has fewer after `grow` steps"""
    grow: int = 1500
    """steps of densification"""
    settle: int = 200
    """steps after that before the first is timed"""
    steps: int = 100
    """steps of a timed stretch"""
    traced: int = 10
    """steps of a variant that are traced"""
    rounds: int = 3
    """turns of each method, and of each model's frames"""

    def main(self) -> None:
        rows: list[dict[str, Any]] = []
        models: dict[str, Any] = {}
        for turn in range(self.rounds):
            for method in self.methods:
                found, models[method] = self.measure(method)
                rows += [{"method": method, "round": turn, **row} for row in found]
                self._keep(rows, [])
        frames = [
            {"method": method, "round": turn, "fps": fps(model, cameras), "splats": model.num_points}
            for turn in range(self.rounds)
            for method, (model, cameras) in models.items()
        ]
        self._keep(rows, frames)
        print(self.out.read_text())

    def _keep(self, rows: list[dict[str, Any]], frames: list[dict[str, Any]]) -> None:
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps({"machine": machine(), "steps": rows, "frames": frames}, indent=1) + "\n")

    def measure(self, method: str) -> tuple[list[dict[str, Any]], tuple[Any, dict[str, list]]]:
        """Train a method and time its variants; the model is there afterwards, with test cameras by their size."""
        variants = [(name, VARIANTS[name]) for name in self.variants]
        length = 5 + self.steps + self.traced + 1  # the first few of a variant are not timed
        begin = self.grow + self.settle
        args = [method, "--max-num-iterations", str(begin + length * len(variants) + 1), "--vis", "tensorboard"]
        args += ["--steps-per-save", "1000000", "--steps-per-eval-image", "1000000"]
        args += ["--steps-per-eval-all-images", "1000000", "--logging.local-writer.enable", "False"]
        args += ["--logging.profiler", "none", "--pipeline.model.num-downscales", "0"]
        folder = tempfile.mkdtemp()  # left behind: tensorboard's thread writes to it until the process ends
        rows: list[dict[str, Any]] = []
        with host_without_downloads(method), contextlib.ExitStack() as closing, waiting() as waited:
            config = parse([method, "--output-dir", folder, *args[1:], "nrfgs-data", "--data", str(self.scene)])
            config.save_config()
            _set_random_seed(config.machine.seed)
            trainer = config.setup(local_rank=0, world_size=1)
            trainer.setup()
            model, graphs = trainer.pipeline.model, trainer.graphs
            watch: list[Any] = []
            busy: list[float] = []

            def after(step: int) -> None:
                if step == self.grow:
                    keep_only(self.splats, model, trainer.optimizers.optimizers)
                    model.densification.strategy.refine_every = model.densification.strategy.reset_every = NEVER
                which, at = divmod(step - begin, length)
                if not 0 <= which < len(variants):
                    return
                name, closed = variants[which]
                if at == 0:
                    model.densification.strategy.refine_stop_iter = 0 if "at rest" in name else NEVER
                    trainer.graphs = None if "graph" in closed else graphs
                    closing.enter_context(shut(closed))
                if 5 <= at <= 5 + self.steps:
                    busy.append(perf_counter() - waited[0])
                if at in (5, 5 + self.steps):
                    torch.cuda.synchronize()
                    watch.append(perf_counter())
                if at == 5 + self.steps:
                    watch.append(profile(activities=[ProfilerActivity.CUDA]))
                    watch[-1].start()
                if at == length - 1:
                    torch.cuda.synchronize()
                    watch[-1].stop()
                    start, end, traced = watch
                    watch.clear()
                    closing.close()
                    row = {"variant": name, "splats": model.num_points, "recorded": bool(graphs._graphs)}
                    row["step_ms"] = 1e3 * (end - start) / self.steps
                    row["host_ms"] = 1e3 * statistics.median(b - a for a, b in zip(busy, busy[1:], strict=False))
                    rows.append({**row, **kernels(traced, self.traced)})
                    busy.clear()

            trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
            with contextlib.redirect_stdout(sys.stderr):
                trainer.train()
        model.eval()
        own = [camera for camera, _ in trainer.pipeline.datamanager.fixed_indices_eval_dataloader]
        trainer.graphs = None
        gc.collect()
        return rows, (model, {"own": own, "1080p": [at_size(camera, *FULL_HD) for camera in own]})


def keep_only(count: int, model: Any, by_group: Mapping[str, torch.optim.Optimizer]) -> None:
    """Take splats out of a training, any of them, until there are no more than `count`."""
    if model.num_points > count:
        bad = torch.zeros(model.num_points, dtype=torch.bool, device=model.device)
        bad[torch.randperm(len(bad), device=model.device)[: len(bad) - count]] = True
        remove_splats(model, by_group, bad)


@contextlib.contextmanager
def shut(names: tuple[str, ...]) -> Iterator[None]:
    """Leave the work of parts with a gate to gsplat or PyTorch."""
    gates = [GATES[name] for name in names if name in GATES]
    before = [dict(gate) for gate in gates]
    for gate in gates:
        gate.update(dict.fromkeys(gate, "it is measured without"))
    try:
        yield
    finally:
        for gate, known in zip(gates, before, strict=True):
            gate.update(known)


@contextlib.contextmanager
def waiting() -> Iterator[list[float]]:
    """Seconds that the host has waited for the GPU at events, the only number of a list."""
    waited = [0.0]
    wait = torch.cuda.Event.synchronize

    def timed(event: torch.cuda.Event) -> None:
        start = perf_counter()
        wait(event)
        waited[0] += perf_counter() - start

    torch.cuda.Event.synchronize = timed
    try:
        yield waited
    finally:
        torch.cuda.Event.synchronize = wait


def kernels(watch: profile, steps: int) -> dict[str, Any]:
    """The GPU's time and launches of traced steps, each per step, and the kernels that take longest."""
    found: dict[str, list[float]] = {}
    for event in watch.events():
        if event.device_type == torch.autograd.DeviceType.CUDA and not event.is_user_annotation:
            entry = found.setdefault(event.name[:80], [0, 0.0])
            entry[0] += 1 / steps
            entry[1] += event.device_time / steps
    longest = sorted(found.items(), key=lambda item: -item[1][1])[:12]
    return {
        "gpu_ms": sum(time for _, time in found.values()) / 1e3,
        "launches": sum(count for count, _ in found.values()),
        "kernels": [[name, count, time] for name, (count, time) in longest],
    }


def fps(model: Any, cameras: Mapping[str, list]) -> dict[str, float]:
    """Frames per second by the size of the picture, and with gsplat's lists of what tiles draw."""
    found = {size: frames_per_second(model, some) for size, some in cameras.items()}
    with shut(("lists",)):
        return found | {f"{size}, gsplat's lists": frames_per_second(model, some) for size, some in cameras.items()}


if __name__ == "__main__":
    tyro.cli(StepParts).main()
