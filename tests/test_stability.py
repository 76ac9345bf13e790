# SPDX-License-Identifier: Apache-2.0
"""The catalogue of extremes holds, and its tests exist; hard trainings end finite (docs/troubleshooting.md)."""

import ast
import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from short_trainings import command_line, trained
from small_capture import rescale
from stability_catalogue import CATALOGUE

from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_lab.training_run import evaluate
from nrfgs_ns.method_config import nrfgs

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("quantity", CATALOGUE, ids=lambda quantity: quantity.name)
def test_check_holds(quantity):
    assert quantity.check() is True


def test_every_test_that_is_named_exists():
    for file, name in {tuple(test.split("::")) for quantity in CATALOGUE for test in quantity.tests}:
        tree = ast.parse((ROOT / file).read_text())
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{file}::{name}"


def paint(folder: Path, value: int) -> None:
    for path in (folder / "images").glob("*.png"):
        Image.fromarray(np.full_like(np.array(Image.open(path)), value)).save(path)


def keep(folder: Path, count: int) -> None:
    """Keep the first `count` training frames, all with the first one's image and pose."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    by_name = {frame["file_path"]: frame for frame in meta["frames"]}
    names = meta["train_filenames"][:count]
    for name in names[1:]:
        shutil.copy(folder / names[0], folder / name)
        by_name[name]["transform_matrix"] = by_name[names[0]]["transform_matrix"]
    meta |= {"train_filenames": names, "val_filenames": [], "test_filenames": []}
    path.write_text(json.dumps({**meta, "frames": [by_name[name] for name in names]}))


RESETS = "splatfacto,warmup_length=100,refine_every=25,reset_alpha_every=2"
FAST = {f"--optimizers.{name}.optimizer.lr": 10 * one["optimizer"].lr for name, one in nrfgs.config.optimizers.items()}
OWN_UNIT = ("nrfgs-data", "--auto-scale-poses", "False")
HARD = {
    "a unit of a kilometre": (partial(rescale, factor=1e-3), {}, OWN_UNIT),
    "a unit of a millimetre": (partial(rescale, factor=1e3), {}, OWN_UNIT),
    "learning rates x 10": (lambda folder: None, FAST, ()),
    "opacity reset every 50 steps": (lambda folder: None, {"--pipeline.model.densification": RESETS}, ()),
    "black images": (partial(paint, value=0), {}, ()),
    "white images": (partial(paint, value=255), {}, ()),
    "one image": (partial(keep, count=1), {}, ()),
    # With auto-scaling, cameras at one place are refused: they have no extent to scale by.
    "two identical images": (partial(keep, count=2), {}, OWN_UNIT),
}
"""What is done to the data set, options, and words for the data parser."""


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD)
def test_hard_trainings_end_finite(name, tmp_path):
    edit, options, words = HARD[name]
    data = write_scene(SceneConfig(views=16, width=48, height=36, points=600, samples=2), tmp_path / "scene")
    edit(data)
    usual = {"--pipeline.model.num-downscales": 0, "--pipeline.model.densification": "splatfacto,warmup_length=100"}
    config = trained([*command_line("nrfgs", data, tmp_path / "outputs", 200, usual, options), *words])
    results = evaluate(config, tmp_path / "eval.json")
    assert all(results[name] is not None for name in ("psnr", "ssim", "l1"))  # what is NaN is None there
    _, pipeline, _, _ = eval_setup(config)
    assert all(torch.isfinite(value).all() for value in pipeline.model.parameters())
