# SPDX-License-Identifier: Apache-2.0
"""`nrfgs_lab.timing.scale`: its cells are measured once, from made splats and from a training's."""

import json
import sys
from pkgutil import resolve_name
from types import SimpleNamespace

import pytest
import torch
from short_trainings import LOUD, command_line, trained

from nrfgs_lab.timing import photographs, scale
from nrfgs_lab.timing.fits import Fits
from nrfgs_lab.timing.photographs import Photographs, make
from nrfgs_lab.timing.scale import Bare, Scale, at_megapixels, made, resampled

pytestmark = pytest.mark.usefixtures("no_cuda")


def test_cells_are_measured_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scale, "WARM", 1)
    monkeypatch.setattr(scale, "PROFILED", 1)
    monkeypatch.setattr(scale, "frames_per_second", lambda model, cameras: float(model.num_points * len(cameras)))
    run = Scale(tmp_path / "scale.jsonl", splats=(300,), megapixels=(48 * 32e-6,), repeats=1, steps=1)
    run.main()
    lines = run.out.read_text()
    first, second = map(json.loads, lines.splitlines())
    assert [first["method"], second["method"]] == ["nrfgs", "nrfgs-sh"]
    assert first["step_ms"] > 0 and first["1080p"] == first["4K"] == 300 * 16
    assert "faster-gs is left out: it needs CUDA and FasterGSCudaBackend" in capsys.readouterr().out
    run.main()
    assert run.out.read_text() == lines


def test_a_training_is_resampled(tiny_scene, tmp_path):
    config = trained(command_line("nrfgs", tiny_scene, tmp_path, 2, LOUD))
    few, many = resampled(config, 20), resampled(config, 1000)
    assert [len(some.splats["means"]) for some in (few, many)] == [20, 1000]
    covered = [float(some.splats["scales"].double().mul(2).exp().sum()) for some in (few, many)]
    assert covered[0] == pytest.approx(covered[1], rel=0.5)
    assert len(few.photographs) == len(few.cameras)


def test_a_bare_step_moves_every_tensor(monkeypatch):
    """With a stand-in for gsplat's kernels, which need CUDA."""
    seen = []

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, packed):
        seen.append((viewmats.shape, colors.shape))
        color = (colors.sum(1) + means * opacities[:, None] + scales * quats[:, :3]).sigmoid().mean(0)
        return color.expand(1, height, width, 3), None, {}

    monkeypatch.setattr(scale, "import_module", {"gsplat": SimpleNamespace(rasterization=rasterization)}.__getitem__)
    capture = at_megapixels(made(50), 48 * 32e-6)
    bare = Bare("gsplat", capture.splats, "cpu")
    before = {name: value.detach().clone() for name, value in bare.splats.items()}
    bare.step(capture.cameras[:1], capture.photographs[0])
    assert seen == [((1, 4, 4), (50, 16, 3))]
    assert all(not torch.equal(before[name], value) for name, value in bare.splats.items())


def test_trainings_and_parts_are_measured_once(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(scale, "WARM", 1)
    monkeypatch.setattr(scale, "PROFILED", 1)
    options = "--max-num-iterations 2 --pipeline.model.dense-start off"
    size = {"megapixels": 48 * 32e-6, "splats": (200, 300), "methods": ("nrfgs-sh",), "gigabytes": (8.0,)}
    run = Fits(tmp_path / "fits.jsonl", tiny_scene, options=options, **size)
    run.main()
    lines = run.out.read_text()
    few, many, trained = map(json.loads, lines.splitlines())
    assert not any("failed" in record for record in (few, many, trained))
    assert many["parameters_mb"] - few["parameters_mb"] == pytest.approx(100 * 4 * (3 + 3 + 4 + 1 + 3 + 45) / 1e6)
    assert many["moments_mb"] == pytest.approx(2 * many["parameters_mb"])
    assert trained["splats"] == 300 and trained["steps"] == 2 and trained["psnr"] > 5
    run.main()
    assert run.out.read_text() == lines


def test_a_capture_is_made_and_read(tmp_path, monkeypatch, capsys):
    """In this process: another one would import everything again."""

    def run(command, **_):
        monkeypatch.setattr(sys, "argv", command[2:])
        capsys.readouterr()
        exec(command[2], {})
        return SimpleNamespace(stdout=capsys.readouterr().out)

    for path in photographs.PARTS.values():  # which are replaced for good
        monkeypatch.setattr(path, resolve_name(path))
    monkeypatch.setattr(photographs, "subprocess", SimpleNamespace(run=run, PIPE=None))
    make(tmp_path / "small", 10, 60, 40)
    Photographs(tmp_path / "out.json", data=(tmp_path / "small",)).main()
    (record,) = json.loads((tmp_path / "out.json").read_text())["records"].values()
    assert record["size"] == [60, 40] and record["views"] == 9
    assert record["decoded_bytes"] == 10 * 60 * 40 * 3
    assert 0 < record["points"] <= record["splats"]
    assert {"all", "images"} <= record["seconds"].keys() and record["own_bytes"] > 0
