# SPDX-License-Identifier: Apache-2.0
"""Whole trainings, and trainings that are killed."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from short_trainings import assert_same_training, command_line, trained
from smoke_runs import PLAIN, bound, gain_bound
from smoke_runs import STEPS as SHORT

from nrfgs_lab.scenes import SceneConfig, write_scene
from nrfgs_lab.training_run import evaluate
from nrfgs_ns.densification import Splatfacto
from nrfgs_ns.training.checkpoint_files import read_latest


def psnr(method: str, data: Path, out: Path, steps: int, *options: dict) -> float:
    args = command_line(method, data, out, steps, PLAIN, *options)
    return evaluate(trained(args), out / f"{method}.json")["psnr"]


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["fox", "kitchen"])
def test_real_photographs_train_and_the_field_is_ahead_of_harmonics(scene, captures, tmp_path):
    scale = {"--pipeline.datamanager.camera-res-scale-factor": 0.125}
    reached = {
        method: psnr(method, captures / scene, tmp_path, SHORT, scale, {"--machine.seed": 42})
        for method in ("nrfgs", "nrfgs-sh")
    }
    assert all(value > bound(f"{scene}/{method}") for method, value in reached.items()), reached
    assert reached["nrfgs"] - reached["nrfgs-sh"] > gain_bound(scene), reached


SERVER = Path(__file__).resolve().parents[1] / "helpers" / "forked_trainings.py"
STEPS = 30
OPTIONS = {
    "--steps-per-save": 1,
    "--average-steps": 4,
    "--pipeline.model.densification": Splatfacto(
        warmup_length=2, refine_every=4, reset_alpha_every=6, densify_grad_thresh=1e-6
    ),
    "--pipeline.model.num-downscales": 0,
    "--timestamp": "run",
}
"""A checkpoint after each step; refinements and a reset of opacities happen."""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks a process that has imported torch")
def test_trainings_that_are_killed_go_on_to_the_bit(tiny_scene, tmp_path):
    """SIGKILL while the checkpoint after a step is being written. Step 1's is the first: nerfstudio saves none at 0."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
    server = subprocess.Popen([sys.executable, str(SERVER)], **pipes)

    def ends(name: str, killed_at: int | None = None, *more: dict) -> int:
        words = command_line("nrfgs", tiny_scene, tmp_path / name, STEPS, OPTIONS, *more)
        print(json.dumps([killed_at, words]), file=server.stdin, flush=True)
        return int(server.stdout.readline())

    def models(name: str) -> Path:
        return tmp_path / name / tiny_scene.name / "nrfgs" / "run" / "nerfstudio_models"

    with server:
        assert ends("whole") == 0
        _, whole = read_latest(models("whole"))
        assert whole["step"] == STEPS - 1
        for step in range(2, STEPS - 1):
            assert ends(f"killed-{step}", step) == -signal.SIGKILL
            assert read_latest(models(f"killed-{step}"))[1]["step"] == step - 1
            assert ends(f"goes-on-{step}", None, {"--load-dir": models(f"killed-{step}")}) == 0
            assert_same_training(whole, read_latest(models(f"goes-on-{step}"))[1], rtol=0, atol=0)
