# SPDX-License-Identifier: Apache-2.0
"""Real trainings: minutes, not seconds. Run with `pytest -m slow`."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import command_line, trained

from nrfgs_ns.scenes import SceneConfig, write_scene
from nrfgs_ns.training.run import evaluate, train

pytestmark = pytest.mark.slow


def psnr(method: str, data: Path, out: Path, steps: int, *options: dict) -> float:
    args = command_line(method, data, out, steps, {"--pipeline.model.num-downscales": 0}, *options)
    return evaluate(trained(args), out / f"{method}.json")["psnr"]


def test_the_field_carries_what_depends_on_the_view(tmp_path):
    """On mirror-like balls, taking the field away from a trained model must cost more than rounding to 8 bits could."""
    data = write_scene(SceneConfig(gloss=1.0, views=24, width=100, height=76, points=2000), tmp_path / "scene")
    psnr("nrfgs", data, tmp_path, 500)
    (config,) = tmp_path.rglob("config.yml")
    _, pipeline, _, _ = eval_setup(config)
    errors = {"whole": [], "base": []}
    for camera, batch in pipeline.datamanager.fixed_indices_eval_dataloader:
        truth = pipeline.model.get_gt_img(batch["image"])
        errors["whole"].append((pipeline.model.get_outputs_for_camera(camera)["rgb"] - truth).square().mean())
        errors["base"].append((pipeline.model.get_base_color(camera) - truth).square().mean())
    whole, base = (torch.stack(errors[which]).mean() for which in ("whole", "base"))
    # At this error (PSNR near 25 dB, 0.056 root mean square) half an 8-bit step in every pixel is 0.001 dB.
    assert 10 * torch.log10(base / whole) > 0.1


@pytest.mark.parametrize("scene", ["fox", "kitchen"])
@pytest.mark.parametrize("method", ["nrfgs", "nrfgs-sh"])
def test_real_photographs_train(scene, method, captures, tmp_path):
    scale = {"--pipeline.datamanager.camera-res-scale-factor": 0.125}
    assert psnr(method, captures / scene, tmp_path, 300, scale) > 17


def test_killed_training_goes_on_from_its_checkpoint(tiny_scene, tmp_path):
    """SIGKILL in the middle of `ns-train`; what is left on disk continues."""
    usual = {"--steps-per-save": 20, "--logging.local-writer.enable": None, "--logging.profiler": None}
    args = command_line("nrfgs", tiny_scene, tmp_path, 100_000, usual)
    code = "from nerfstudio.scripts.train import entrypoint; entrypoint()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *args], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    deadline = time.time() + 120
    while time.time() < deadline and not list(tmp_path.rglob("nerfstudio_models/step-0000001*")):
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    checkpoint = max(tmp_path.rglob("nerfstudio_models/*.ckpt"))
    reached = int(checkpoint.stem.split("-")[1])
    assert reached >= 100
    record = train(command_line("nrfgs", tiny_scene, tmp_path, reached + 4, usual, {"--load-dir": checkpoint.parent}))
    assert record.splats[-1][0] == reached + 3
