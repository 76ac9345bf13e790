# SPDX-License-Identifier: Apache-2.0
"""The viewer's pictures and the exported files on a CUDA device. `pytest -m gpu`. On a CPU their rooms test them."""

import json
from itertools import combinations
from pathlib import Path

import pytest
import torch
from short_trainings import command_line, trained, untrained

from nrfgs_lab.training_run import evaluate
from nrfgs_ns.export.command import Compact, Ply
from nrfgs_ns.export.ply import read_splats
from nrfgs_ns.viewer.pictures import AMPLIFICATION, BASE, DEPTH, FULL, VIEW_DEPENDENCE, legends, picture

pytestmark = pytest.mark.gpu
FROZEN = "full, as seen from another camera"
STEPS = 60


def viewer_pictures(device: str, scene: Path, out: Path) -> dict[str, torch.Tensor]:
    """The picture of every mode, and of a frozen view, on the CPU; the field is drawn at random, on all devices
    alike."""
    words = "--pipeline.model.background-color black --pipeline.model.few-views off"
    words += " --pipeline.model.appearance.precision fp32"  # as on the CPU
    pipeline = untrained(scene, out, "nrfgs", *words.split(), device=device)
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras.to(device)
    generator = torch.Generator().manual_seed(1)
    drawn = {"latents": 0.3, "scales": 0.5}
    for name, parameter in [*model.head.named_parameters(), *model.gauss_params.items()]:
        if name in drawn or name not in model.gauss_params:
            noise = torch.randn(parameter.shape, generator=generator).to(device) * drawn.get(name, 0.5)
            parameter.data = noise if name != "scales" else parameter.data + noise
    model.gauss_params["opacities"].data.fill_(1.0)  # a pixel shows few splats
    model.update_to_step(10**6)
    pipeline.eval()
    camera, elsewhere = cameras[0:1], cameras[4:5].camera_to_worlds[0, :3, 3]
    shown = {mode: {"mode": mode} for mode in legends(model.field)}
    shown[FROZEN] = {"frozen_center": elsewhere}
    pictures = {}
    for name, what in shown.items():
        pictures[name] = picture(model, camera, **what)["rgb"]
        assert pictures[name].shape == (36, 48, 3) and pictures[name].device.type == device, name
        assert ((pictures[name] >= 0) & (pictures[name] <= 1)).all(), name  # NaN is in no interval
    assert torch.equal(pictures[FULL], model.get_outputs_for_camera(camera)["rgb"])
    assert torch.equal(pictures[BASE], model.get_base_color(camera))
    for pair in combinations(pictures, 2):
        assert (pictures[pair[0]] - pictures[pair[1]]).abs().max() > 0.02, pair
    return {name: value.cpu() for name, value in pictures.items()}


def test_exported_files(tiny_scene, tmp_path):
    """Train, write both files, read them back: each loses less than a third of what the residual adds."""
    out = tmp_path
    options = {
        "--machine.device-type": "cuda",
        "--pipeline.model.few-views": "off",
        "--pipeline.model.num-downscales": 0,
        "--optimizers.field.optimizer.lr": 0.05,  # a residual that matters after a few steps
    }
    config = trained(command_line("nrfgs", tiny_scene, out, STEPS, options))
    scores = evaluate(config, out / "eval.json")
    reports = {}
    Ply(config, output=out / "splats.ply", report=out / "ply.json", steps=8).main()
    Compact(config, output=out / "field.nrf", report=out / "compact.json").main()
    for kind in ("ply", "compact"):
        reports[kind] = json.loads((out / f"{kind}.json").read_text())
        # The report's mean over the images is ns-eval's, which sums in another order.
        assert reports[kind]["psnr_model"] == pytest.approx(scores["psnr"], abs=1e-3)
    assert len(read_splats(out / "splats.ply").means) == reports["ply"]["written"] > 100
    small = evaluate(out / "field.nrf.nerfstudio" / "nrfgs" / "compact" / "config.yml", out / "small.json")
    assert small["psnr"] == pytest.approx(reports["compact"]["psnr_file"], abs=1e-3)
    ply, compact = reports["ply"], reports["compact"]
    worth = ply["psnr_model"] - ply["psnr_base"]
    assert worth > 0.5
    # The PLY's fine-tuning goes on where a training of 60 steps stopped, so that it may gain; encoding alone cannot.
    assert ply["loss_db"] < worth / 3 and abs(compact["loss_db"]) < worth / 3
    # Nearly half of so small a file is the network, which all splats share.
    assert compact["ply_ratio"] > 2


def test_every_mode(tiny_scene, tmp_path):
    """The pictures are the CPU's."""
    gpu = viewer_pictures("cuda", tiny_scene, tmp_path)
    cpu = viewer_pictures("cpu", tiny_scene, tmp_path)
    assert gpu.keys() == cpu.keys() and {DEPTH, VIEW_DEPENDENCE, "gate weight", "opacity residual"} <= gpu.keys()
    for name in gpu:
        error = (gpu[name] - cpu[name]).abs()
        # A contribution that only one device cuts at alpha = 1/255 moves a blended number by 1/255 of its range; few
        # pixels have one. Changes are drawn AMPLIFICATION times as large, and viridis is less steep than 2.
        assert (error > 2 * AMPLIFICATION / 255).float().mean() < 0.01, name
        assert error.mean() < 1e-3, name
