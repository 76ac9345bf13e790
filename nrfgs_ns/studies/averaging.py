# SPDX-License-Identifier: Apache-2.0
"""What the mean over a training's last steps is worth, by how many they are: one training, and all windows from it.

    python -m nrfgs_ns.studies.averaging --method nrfgs --scene FOLDER --work WORK --out RECORD.json

trains once, keeps a mean (`averaging.py`) for each window, and evaluates the test views with each of them. Window 0 is
the last step's numbers. No window changes the training, so that they differ in nothing else.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed
from rich.progress import track

from nrfgs_ns.averaging import ParameterMean
from nrfgs_ns.errors import InputError
from nrfgs_ns.metrics import METRIC_NAMES
from nrfgs_ns.studies.bench_spec import QUIET
from nrfgs_ns.studies.files import write_whole
from nrfgs_ns.studies.run import machine, parse
from nrfgs_ns.trainer import NrfgsTrainer, NrfgsTrainerConfig


@dataclass
class AveragingStudy:
    """One training, and means over its last steps."""

    scene: Path
    """folder of the data set"""
    work: Path
    """folder for what the training writes"""
    out: Path
    """file for the record"""
    method: str = "nrfgs"
    """a method of this project"""
    steps: int = 1500
    """of the training"""
    windows: tuple[int, ...] = (0, 25, 50, 100, 200, 400)
    """numbers of last steps that are averaged over"""
    options: str = ""
    """more options of ns-train, without those of the data set. On the command line with an equals sign:
    --options="--NAME VALUE ...", because they begin with dashes"""
    seed: int = 42
    """of the training"""

    def main(self) -> None:
        if not self.windows or min(self.windows) < 0:
            raise InputError(f"--windows is {self.windows}; give numbers of steps, zero or more.")
        trainer = self.trainer()
        means = {window: ParameterMean() for window in self.windows}
        self.keep(trainer, means)
        trainer.train()
        rows = [row(trainer, window, means[window]) for window in track(self.windows, "Evaluating windows")]
        content = {
            "method": self.method,
            "scene": self.scene.name,
            "steps": self.steps,
            "seed": self.seed,
            "options": self.options,
            "machine": machine(),
            "windows": rows,
        }
        write_whole(self.out, json.dumps(content, indent=1) + "\n")
        print(as_table(rows))

    def trainer(self) -> NrfgsTrainer:
        """The trainer, ready to train.

        Raises:
            InputError: the method is not of this project, or averages itself.
        """
        own = {
            "--data": self.scene,
            "--output-dir": self.work,
            "--max-num-iterations": self.steps,
            "--machine.seed": self.seed,
        }
        words = [str(word) for option in own.items() for word in option]
        config = parse([self.method, *words, *QUIET, *self.options.split()])
        if not isinstance(config, NrfgsTrainerConfig):
            raise InputError(f"--method is {self.method}; it must be one of this project's.")
        if config.average_steps > 0:
            raise InputError(
                f"{self.method} with these options averages over its last {config.average_steps} steps itself, before "
                'this study does. Leave --average-steps out of --options, or for a preset add "--average-steps 0".'
            )
        config.save_config()
        _set_random_seed(config.machine.seed)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    def keep(self, trainer: NrfgsTrainer, means: dict[int, ParameterMean]) -> None:
        """Let each step be added to the means in whose windows it is."""

        def after(step: int) -> None:
            for window, mean in means.items():
                if step > trainer.last_step - window:
                    mean.add(trainer.pipeline.model, trainer.optimizers.optimizers)

        trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))


@torch.no_grad()
def row(trainer: NrfgsTrainer, window: int, mean: ParameterMean) -> dict[str, Any]:
    """How well a mean renders the test views; the model keeps its parameters.

    Returns:
        The window, the steps that are in the mean (fewer if splats changed within the window), mean metrics over the
        test views (null where one cannot be had), and the number of splats.
    """
    averaged, parameters = mean.count, list(trainer.pipeline.model.parameters())
    last = [parameter.clone() for parameter in parameters]
    mean.install()
    result = trainer.pipeline.get_average_eval_image_metrics(get_std=True)
    for parameter, value in zip(parameters, last, strict=True):
        parameter.copy_(value)
    metrics = {name: result[name] for name in METRIC_NAMES}
    return {"window": window, "averaged": averaged, **metrics, "splats": int(result["splats"])}


def as_table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = ["| last steps | averaged | PSNR | SSIM | splats |", "| ---: | ---: | ---: | ---: | ---: |"]
    for row in rows:
        lines.append(
            f"| {row['window']} | {row['averaged']} | {row['psnr']:.2f} | {row['ssim']:.4f} | {row['splats']:,} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    tyro.cli(AveragingStudy, description=__doc__).main()
