# SPDX-License-Identifier: Apache-2.0
"""`nrfgs_lab.timing.fits`: what it measures is measured once, and a card's memory is a share of another's."""

import json

import pytest
import torch

from nrfgs_lab.timing import fits, scale
from nrfgs_lab.timing.fits import Fits


@pytest.mark.usefixtures("no_cuda")
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
    row = 4 * (3 + 3 + 4 + 1 + 3 + 45)
    assert many["parameters_mb"] - few["parameters_mb"] == pytest.approx(100 * row / 1e6)
    assert many["moments_mb"] == pytest.approx(2 * many["parameters_mb"])
    assert trained["splats"] == 300 and trained["steps"] == 2 and trained["psnr"] > 5
    run.main()
    assert run.out.read_text() == lines


def test_a_smaller_card_has_cuda_s_own_part_too(monkeypatch):
    shares = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (74e9, 80e9))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda: 5e9)
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", shares.append)
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda: None)
    fits.limit(12.0)
    fits.limit(96.0)
    assert shares == [11 / 80, 1.0]
