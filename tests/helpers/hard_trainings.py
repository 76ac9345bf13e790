# SPDX-License-Identifier: Apache-2.0
"""Hard trainings: each must end with finite numbers, and the unit of length must not decide how well.

    python tests/helpers/hard_trainings.py --out bench/stability --work FOLDER

trains on small procedural scenes and writes `trainings.json`, with one entry for each run. A run that is in the JSON
already is not repeated.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from plyfile import PlyData
from rich.progress import track
from short_trainings import command_line, trained

from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_lab.training_run import evaluate, machine
from nrfgs_ns.method_config import nrfgs

SCENE = SceneConfig(views=16, width=48, height=36, points=600, samples=2)
"""Small enough for a run a minute on one core."""
RESETS = {"--pipeline.model.densification": "splatfacto,warmup_length=100,refine_every=25,reset_alpha_every=2"}
"""Reset all opacities every 50th step; splatfacto then neither adds nor deletes splats for longer than that."""

NO_SCREEN_SIZE = {"--pipeline.model.densification": "splatfacto,warmup_length=100,stop_screen_size_at=0"}
"""Do not split splats for being wide on the screen: splatfacto's bound, a twentieth of the image, is 2.4 pixels here,
less than the blur that every splat gets, and 600 points became 150,000 splats for 28,000 pixels within 1,100 steps."""


@dataclass
class HardTraining:
    """One training that a user's capture could be: its name, the change of the data set, options of ns-train."""

    name: str
    edit: Callable[[Path], None] = lambda folder: None
    options: dict[str, Any] = field(default_factory=dict)
    auto_scale: bool = True
    """nerfstudio's scaling of poses into a unit cube"""
    method: str = "nrfgs"
    seeds: tuple[int, ...] = (42,)
    """one training for each"""
    steps: int | None = None
    """None: those of the others"""


def rescale(folder: Path, factor: float) -> None:
    """Measure the scene in another unit: every length in poses and points times `factor`."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    for frame in meta["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= factor
    path.write_text(json.dumps(meta))
    points = PlyData.read(str(folder / meta["ply_file_path"]), mmap=False)
    for axis in "xyz":
        points["vertex"][axis] *= factor
    points.write(str(folder / meta["ply_file_path"]))


def paint(folder: Path, value: int) -> None:
    """Every image in one grey, 0 to 255."""
    for path in (folder / "images").glob("*.png"):
        Image.fromarray(np.full_like(np.array(Image.open(path)), value)).save(path)


def keep(folder: Path, count: int, identical: bool = False) -> None:
    """Keep the first `count` training frames, all with the first one's image and pose if `identical`."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    by_name = {frame["file_path"]: frame for frame in meta["frames"]}
    names = meta["train_filenames"][:count]
    for name in names[1:] if identical else ():
        shutil.copy(folder / names[0], folder / name)
        by_name[name]["transform_matrix"] = by_name[names[0]]["transform_matrix"]
    meta |= {"train_filenames": names, "val_filenames": [], "test_filenames": []}
    path.write_text(json.dumps({**meta, "frames": [by_name[name] for name in names]}))


def hard_trainings() -> list[HardTraining]:
    """All rows of the table."""
    seeds = (42, 43, 44)
    groups = nrfgs.config.optimizers.items()
    fast = {f"--optimizers.{name}.optimizer.lr": 10 * group["optimizer"].lr for name, group in groups}
    rows = []
    for method in ("nrfgs", "nrfgs-sh"):
        for auto_scale in (True, False):
            for factor in (1.0, 1e-3, 1e3):
                name = f"{method}, unit x {factor:g}, auto-scaling {'on' if auto_scale else 'off'}"
                edit = partial(rescale, factor=factor)
                rows.append(HardTraining(name, edit, auto_scale=auto_scale, method=method, seeds=seeds))
    return [
        *rows,
        HardTraining("learning rates x 10", options=fast),
        HardTraining("100,000 steps", options=NO_SCREEN_SIZE, steps=100_000),
        HardTraining("opacity reset every 50 steps", options=RESETS),
        HardTraining("black images", partial(paint, value=0)),
        HardTraining("white images", partial(paint, value=255)),
        HardTraining("one image", partial(keep, count=1)),
        # With auto-scaling, cameras at one place are refused: they have no extent to scale by.
        HardTraining("two identical images", partial(keep, count=2, identical=True), auto_scale=False),
    ]


def run(training: HardTraining, seed: int, steps: int, work: Path) -> dict[str, Any]:
    """Train and evaluate in the folder `work`, which is emptied. "finite": every tensor of the checkpoint and every
    number of the evaluation is."""
    shutil.rmtree(work, ignore_errors=True)
    data = write_scene(SCENE, work / "scene")
    training.edit(data)
    small = {
        "--machine.seed": seed,
        "--steps-per-eval-all-images": 10**6,
        "--steps-per-eval-image": 10**6,
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.densification": "splatfacto,warmup_length=100",
    }
    args = command_line(training.method, data, work / "outputs", steps, small, training.options)
    config = trained([*args, "nrfgs-data", "--auto-scale-poses", str(training.auto_scale)])
    results = evaluate(config, work / "eval.json")
    _, pipeline, _, _ = eval_setup(config)
    tensors = all(bool(torch.isfinite(value).all()) for value in pipeline.model.parameters())
    numbers = [results[name] for name in ("psnr", "ssim", "l1")]
    finite = tensors and all(number is not None for number in numbers)  # evaluate() returns None for NaN
    return {"psnr": results["psnr"], "l1": results["l1"], "splats": results["splats"], "finite": finite}


def main(out: Path, work: Path, steps: int = 400) -> None:
    """Run all hard trainings.

    Args:
        out: folder for trainings.json.
        work: folder for data sets and checkpoints.
        steps: steps of each training that has no length of its own.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / "trainings.json"
    record = json.loads(file.read_text()) if file.exists() else {"machine": machine(), "steps": steps, "runs": {}}
    todo = [(training, seed) for training in hard_trainings() for seed in training.seeds]
    for index, (training, seed) in enumerate(track(todo, "Hard trainings")):
        done = record["runs"].setdefault(training.name, {})
        if str(seed) not in done:
            # A folder each: tensorboard's writers outlive their training.
            done[str(seed)] = run(training, seed, training.steps or steps, work / f"run-{index}")
            file.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
