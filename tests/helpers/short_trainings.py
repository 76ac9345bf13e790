# SPDX-License-Identifier: Apache-2.0
"""Trainings of a few steps: their command line, what they leave, and whether two are the same."""

import json
from copy import deepcopy
from functools import cache
from pathlib import Path
from statistics import stdev
from typing import Any

import torch
from torch.testing import assert_close

from nrfgs_lab import training_run
from nrfgs_lab.training_run import parse, train
from nrfgs_ns.method_config import nrfgs
from nrfgs_ns.training.checkpoint_files import read_latest
from nrfgs_ns.training.trainer import NrfgsTrainer
from nrfgs_ns.training.trainer_config import NrfgsTrainerConfig

QUIET = {
    "--vis": "tensorboard",
    "--steps-per-eval-image": 1000,
    "--steps-per-eval-all-images": 1000,
    "--logging.local-writer.enable": False,
    "--logging.profiler": "none",
    "--pipeline.model.dense-start": "off",
}
"""No viewer, no tables on the console, no evaluation within a thousand steps, no plane sweep, which takes seconds."""
REFINING = {
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.densification": "splatfacto,warmup_length=2,refine_every=4",
}
"""Full size, and a refinement at every fourth step."""
LOUD = {
    "--pipeline.model.appearance.output-init": "default",
    "--pipeline.model.appearance.latent-dim": 6,
    "--pipeline.model.warmup-steps": 0,
    "--pipeline.model.few-views": "off",
}
"""A small field that says something before it is trained."""


def command_line(method: str, scene: Path, out: Path, steps: int | None, *options: dict[str, Any]) -> list[str]:
    """Words after `ns-train` of a quiet training; `steps` include those before the checkpoint that it goes on from.

    Options are values by option, dashes included; of several the last counts, and None takes the option away.
    """
    chosen = {"--data": scene, "--output-dir": out, "--max-num-iterations": steps, **QUIET}
    for more in options:
        chosen |= more
    return [method, *(str(word) for option in chosen.items() if option[1] is not None for word in option)]


def config_with(name: str, value: object) -> NrfgsTrainerConfig:
    """The configuration of `nrfgs` with one option, named with its dots, changed."""
    part = config = deepcopy(nrfgs.config)
    *path, last = name.split(".")
    for step in path:
        part = part[step] if isinstance(part, dict) else getattr(part, step)
    setattr(part, last, value)
    return config


def set_up(args: list[str]) -> NrfgsTrainer:
    """A trainer before its first step, with its config.yml and the seed that ns-train sets."""
    config = parse(args)
    config.save_config()
    return training_run.set_up(config)


def untrained(scene: Path, out: Path, method: str = "nrfgs", *options: Any, device="cpu", mode="val"):
    """A pipeline before its training, without a trainer."""
    config = parse([method, "--data", str(scene), "--output-dir", str(out), *map(str, options)])
    torch.manual_seed(0)
    return config.pipeline.setup(device=device, test_mode=mode)


def trained(args: list[str]) -> Path:
    """config.yml of a training, when it has ended."""
    return Path(train(args).config_path)


def models_of(config: Path) -> Path:
    """Where the training with this config.yml has its checkpoints: a folder for --load-dir."""
    return config.parent / "nerfstudio_models"


def checkpoint_of(config: Path) -> dict:
    """The last checkpoint of the training with this config.yml."""
    return read_latest(models_of(config))[1]


def assert_same_training(one: dict, other: dict, rtol: float = 1e-5, atol: float = 1e-7) -> None:
    """Assert that two checkpoints have the same step and tensors: parameters, densification's counts, Adam's moments.
    A training that goes on from its checkpoint is the unbroken one: on the same machine both add the same numbers in
    the same order, so that only a lost state can differ."""
    assert one["step"] == other["step"]
    for part in ("pipeline", "optimizers"):
        assert_close(tensors_of(one[part]), tensors_of(other[part]), rtol=rtol, atol=atol)


def tensors_of(tree: Any, prefix: str = "") -> dict[str, torch.Tensor]:
    """The tensors of a checkpoint's part, by path."""
    if isinstance(tree, torch.Tensor):
        return {prefix: tree}
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, (list, tuple)) else ()
    return {path: leaf for key, value in items for path, leaf in tensors_of(value, f"{prefix}/{key}").items()}


# What trainings of 300 steps reach, from which bounds follow. The record `smoke` has, for each case, the PSNR of
# trainings with several seeds, and that after one step.
RECORDS = Path(__file__).resolve().parents[2] / "results" / "tests.json"
SMOKE_METHODS = "nrfgs", "nrfgs-sh", "nrfgs-vdgs", "nrfgs-gsnb", "nrfgs-sg"
SMOKE_STEPS = 300
PLAIN = {"--pipeline.model.num-downscales": 0, "--pipeline.model.few-views": "off", "--pipeline.model.shrinkage": 0}


@cache
def recorded() -> dict[str, dict[str, Any]]:
    """Case -> "psnr" of its trainings by seed, and "after_one_step", which learns nothing."""
    return json.loads(RECORDS.read_text(encoding="utf-8"))["records"]["smoke"]


def bound(case: str) -> float:
    """PSNR that a training of the case must exceed: four deviations below the least of those recorded. The deviation is
    over seeds, the largest of the cases on the same data set."""
    group = [one for name, one in recorded().items() if name.split("/")[0] == case.split("/")[0]]
    return min(recorded()[case]["psnr"]) - 4 * max(stdev(one["psnr"]) for one in group)


def gain_bound(scene: str) -> float:
    """Decibels by which the field must be above harmonics on a capture: four deviations below the least recorded."""
    field, harmonics = (recorded()[f"{scene}/{method}"]["psnr"] for method in ("nrfgs", "nrfgs-sh"))
    gains = [ours - theirs for ours, theirs in zip(field, harmonics, strict=True)]
    return min(gains) - 4 * stdev(gains)
