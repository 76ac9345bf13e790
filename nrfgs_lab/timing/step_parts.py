# SPDX-License-Identifier: Apache-2.0
"""Milliseconds of a step with and without its CUDA graph, and frames per second, of methods with equal splats.

    python -m nrfgs_lab.timing.step_parts --scene SCENES/bonsai --splats 250000 --out step_parts.json

Each method trains at full resolution until it has more splats, loses the surplus, and goes on with a fixed number. Then
stretches of steps are timed: as they are, without graph, and both again at rest, when densification has ended. At last
the trained models render the test views, at the photographs' size and at 1080p. Methods take turns.
"""

import contextlib
import gc
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed

from nrfgs_lab.bench.measure import FULL_HD, at_size, frames_per_second
from nrfgs_lab.bench.run import host_without_downloads
from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.training_run import machine, parse
from nrfgs_ns.densification.rows import take_rows
from nrfgs_ns.files import write_whole

VARIANTS = "whole", "without graph", "at rest: whole", "at rest: without graph"
UNTIMED = 5
"""First steps of a stretch that are not timed."""
GROW, SETTLE, STEPS = 1500, 200, 100
"""Steps of densification, between it and the first timed stretch, and of a stretch."""
ROUNDS = 3
"""Turns of each method, and of each model's frames."""
NEVER = 10**9


@dataclass
class StepParts:
    """Methods, and the number of splats."""

    scene: Path
    """folder of a data set in nerfstudio's layout"""
    out: Path
    """JSON file of the results"""
    methods: tuple[str, ...] = ("nrfgs", "nrfgs-sh")
    """methods with splatfacto's densification"""
    splats: int = 250_000
    """largest number of splats of each method"""

    def main(self) -> None:
        rows: list[dict[str, Any]] = []
        models: dict[str, Any] = {}
        for turn in range(ROUNDS):
            for method in self.methods:
                stretches, models[method] = self.measure(method)
                rows += [{"method": method, "round": turn, **row} for row in stretches]
        frames = [
            {
                "method": method,
                "round": turn,
                "fps": {size: frames_per_second(model, views) for size, views in cameras.items()},
                "splats": model.num_points,
            }
            for turn in range(ROUNDS)
            for method, (model, cameras) in models.items()
        ]
        write_whole(self.out, json.dumps({"machine": machine(), "steps": rows, "frames": frames}, indent=1) + "\n")
        print(self.out.read_text())

    def measure(self, method: str) -> tuple[list[dict[str, Any]], tuple[Any, dict[str, list]]]:
        """Train a method and time its variants; return them, the model, and the test cameras by size."""
        length = UNTIMED + STEPS + 1
        begin = GROW + SETTLE
        folder = tempfile.mkdtemp()  # left behind: tensorboard's thread writes to it until the process ends
        args = [method, "--output-dir", folder, "--max-num-iterations", str(begin + length * len(VARIANTS) + 1), *QUIET]
        args += ["--steps-per-save", str(NEVER), "--pipeline.model.num-downscales", "0"]
        rows: list[dict[str, Any]] = []
        with host_without_downloads(method):
            config = parse([*args, "nrfgs-data", "--data", str(self.scene)])
            config.save_config()
            _set_random_seed(config.machine.seed)
            trainer = config.setup(local_rank=0, world_size=1)
            trainer.setup()
            pipeline = trainer.pipeline
            model, graphs = pipeline.model, trainer.graphs
            began = 0.0

            def after(step: int) -> None:
                nonlocal began
                strategy = model.densification.strategy
                if step == GROW:
                    kept = torch.randperm(model.num_points, device=model.device)[: self.splats].sort().values
                    take_rows(model, trainer.optimizers.optimizers, kept)
                    strategy.refine_every = strategy.reset_every = NEVER
                which, at = divmod(step - begin, length)
                if not 0 <= which < len(VARIANTS):
                    return
                name = VARIANTS[which]
                if at == 0:
                    strategy.refine_stop_iter = 0 if "at rest" in name else NEVER
                    trainer.graphs = None if "without graph" in name else graphs
                if at in (UNTIMED, UNTIMED + STEPS):
                    torch.cuda.synchronize()
                if at == UNTIMED:
                    began = perf_counter()
                if at == UNTIMED + STEPS:
                    milliseconds = 1e3 * (perf_counter() - began) / STEPS
                    rows.append({"variant": name, "splats": model.num_points, "step_ms": milliseconds})

            trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
            with contextlib.redirect_stdout(sys.stderr):
                trainer.train()
        model.eval()
        own = [camera for camera, _ in pipeline.datamanager.fixed_indices_eval_dataloader]
        trainer.graphs = None
        gc.collect()
        return rows, (model, {"own": own, "1080p": [at_size(camera, *FULL_HD) for camera in own]})


if __name__ == "__main__":
    tyro.cli(StepParts).main()
