# SPDX-License-Identifier: Apache-2.0
"""Where the time of one training step goes on the CPU, on the scene of `nrfgs demo`.

    python -m nrfgs_lab.timing.step_cpu                                # NRF and SH after 300 steps of training
    python -m nrfgs_lab.timing.step_cpu --methods nrfgs --train 1000

Each method trains as the demo trains it; steps per second are counted over its last quarter (densification included).
Then single steps are taken apart: every stage runs on detached inputs, so that its forward and its backward pass can
be timed by themselves, and the gradients are handed from stage to stage by hand. Figures are medians over the steps;
the fastest step is given beside them, for a machine that has other work to do.
"""

import contextlib
import json
import os
import statistics
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed
from torch import Tensor

from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.demo import Demo
from nrfgs_ns.rasterizer.torch_cpu import compositing
from nrfgs_ns.scenes import write_scene
from nrfgs_ns.training.run import parse

SECTIONS = ("data", "projection", "head", "binning", "compositing", "loss", "adam")
PROJECTED = ("means2d", "depths", "conics")


@dataclass
class StepCpu:
    """Which methods, after how many steps."""

    methods: tuple[str, ...] = ("nrfgs", "nrfgs-sh")
    """methods of the demo"""
    train: int = 300
    """training steps before a step is taken apart"""
    steps: int = 40
    """steps that are taken apart"""
    threads: int = 2
    """threads of torch"""
    quick: bool = False
    """the demo's quick scene"""
    out: Path = Path("step_cpu.json")
    """JSON file of the results"""

    def main(self) -> None:
        torch.set_num_threads(self.threads)
        results = {}
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            demo = Demo(out=Path(folder), quick=self.quick)
            data = write_scene(demo.scene(), demo.out / demo.scene_folder)
            for method in self.methods:
                results[method] = self.measure(demo.train_args(method, data, self.train))
                report(method, results[method])
        machine = {"name": f"{os.cpu_count()} CPU cores", "threads": self.threads, "torch": torch.__version__}
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps({"machine": machine, "train": self.train, "methods": results}, indent=1) + "\n")

    def measure(self, args: list[str]) -> dict[str, Any]:
        """Train, then take steps apart."""
        with contextlib.redirect_stdout(sys.stderr):
            config = parse(args)
            config.save_config()
            _set_random_seed(config.machine.seed)
            trainer = config.setup(local_rank=0, world_size=1)
            trainer.setup()
            ends: list[float] = []
            after = TrainingCallback(
                [TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: ends.append(perf_counter())
            )
            trainer.callbacks.append(after)
            trainer.save_checkpoint = lambda step: None
            trainer.train()
        quarter = ends[-max(2, len(ends) // 4) :]
        parts = [take_apart(trainer, self.train + i) for i in range(self.steps + 1)][1:]
        sections = {
            name: {
                "median_ms": 1e3 * statistics.median(part[name] for part in parts),
                "fastest_ms": 1e3 * min(part[name] for part in parts),
            }
            for name in parts[0]
        }
        model = trainer.pipeline.model
        return {
            "splats": model.num_points,
            "image": [model.last_size[1], model.last_size[0]],
            "steps_per_second": (len(quarter) - 1) / (quarter[-1] - quarter[0]),
            "fastest_step_ms": 1e3 * min(b - a for a, b in zip(quarter, quarter[1:], strict=False)),
            "sections": sections,
        }


def take_apart(trainer: Any, step: int) -> dict[str, float]:
    """One training step, stage by stage.

    Returns:
        Seconds of each section, and of its backward pass as "SECTION, backward".
    """
    seconds: dict[str, float] = defaultdict(float)
    model, optimizers = trainer.pipeline.model, trainer.optimizers.optimizers

    @contextlib.contextmanager
    def section(name: str) -> Iterator[None]:
        start = perf_counter()
        yield
        seconds[name] += perf_counter() - start

    with section("data"):
        camera, batch = trainer.pipeline.datamanager.next_train(step)
    with section("projection"):
        view = model.project(camera)
    projected = {name: getattr(view.projection, name) for name in PROJECTED}
    leaves = {name: leaf(tensor) for name, tensor in projected.items()}
    with section("head"):
        appearance = model.field.seen_from(view)
    answered = SplatAppearance(*(leaf(tensor) for tensor in appearance))
    seen = view._replace(projection=replace(view.projection, **leaves))
    with section("compositing"), binning_apart(section):
        outputs, _ = model.composite(seen, answered)
    seconds["compositing"] -= seconds["binning"]
    rgb = leaf(outputs["rgb"])
    with section("loss"):
        losses = model.get_loss_dict({**outputs, "rgb": rgb}, batch)
        loss = sum(losses.values())

    with section("loss, backward"):
        loss.backward()
    with section("compositing, backward"):
        outputs["rgb"].backward(rgb.grad)
    with section("head, backward"):
        backward(appearance, answered)
    with section("projection, backward"):
        backward(projected.values(), leaves.values())
    with section("adam"):
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
    return dict(seconds)


def leaf(tensor: Tensor) -> Tensor:
    """The same values, without history, collecting a gradient."""
    return tensor.detach().requires_grad_()


def backward(outputs: Any, leaves: Any) -> None:
    """Carry on with the gradients that have arrived in `leaves`, which stand for `outputs`."""
    arrived = [(output, leaf.grad) for output, leaf in zip(outputs, leaves, strict=True) if leaf.grad is not None]
    torch.autograd.backward(*zip(*arrived, strict=True))


@contextlib.contextmanager
def binning_apart(section: Any) -> Iterator[None]:
    """Time the making of the tiles' lists, which is a part of compositing."""
    names = ("footprints", "split_into_blocks", "list_tiles")
    originals = {name: getattr(compositing, name) for name in names}

    def timed(function: Any) -> Any:
        def call(*args: Any) -> Any:
            with section("binning"):
                return function(*args)

        return call

    try:
        for name, function in originals.items():
            setattr(compositing, name, timed(function))
        yield
    finally:
        for name, function in originals.items():
            setattr(compositing, name, function)


def report(method: str, result: dict[str, Any]) -> None:
    """Print one method's table."""
    sections = result["sections"]
    size = "{} x {}".format(*result["image"])
    print(f"{method}: {result['splats']} splats, {size}, {result['steps_per_second']:.1f} steps per second")
    print(f"  {'median (fastest), ms':24}{'forward':>16}{'backward':>16}")
    for name in SECTIONS:
        cells = [sections.get(key) for key in (name, f"{name}, backward")]
        texts = ["" if c is None else f"{c['median_ms']:.1f} ({c['fastest_ms']:.1f})" for c in cells]
        print(f"  {name:24}{texts[0]:>16}{texts[1]:>16}")
    print(f"  {'all':24}{sum(s['median_ms'] for s in sections.values()):>16.1f}", flush=True)


if __name__ == "__main__":
    tyro.cli(StepCpu).main()
