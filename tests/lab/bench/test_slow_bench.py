# SPDX-License-Identifier: Apache-2.0
"""`nrfgs bench` as a user would run it: two methods, two protocols, killed in the middle and started again."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from PIL import Image

pytestmark = pytest.mark.slow

SPEC = """
runs: {SH: nrfgs-sh, NRF: nrfgs}
protocols: [original, mcmc@400]
scenes: [tiny]
seeds: [1]
steps: 120
checkpoint_every: 20
train_views: 3
options: --pipeline.model.num-downscales 0 --pipeline.model.warmup-length 10 --pipeline.model.refine-every 10
"""


def test_killed_in_the_middle_and_resumed(tiny_scene, tmp_path):
    (tmp_path / "spec.yaml").write_text(SPEC)
    command = [sys.executable, "-m", "nrfgs_ns.cli", "bench", str(tmp_path / "spec.yaml")]
    command += ["--scenes", str(tiny_scene.parent), "--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    runs = tmp_path / "out" / "runs"
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True)
    cut_off = tmp_path / "work" / "NRF-original-tiny-1"
    deadline = time.time() + 300
    while time.time() < deadline and not list(cut_off.rglob("nerfstudio_models/step-0000000[4-9]*.ckpt")):
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGKILL)  # the benchmark and its child, as when a machine goes down
    first.wait()
    assert [file.name for file in runs.iterdir()] == ["SH-original-tiny-1.json"]
    finished = (runs / "SH-original-tiny-1.json").stat().st_mtime_ns

    subprocess.run(command, check=True)
    assert (runs / "SH-original-tiny-1.json").stat().st_mtime_ns == finished
    records = {file.stem: json.loads(file.read_text()) for file in runs.glob("*.json")}
    assert set(records) == {
        f"{run}-{protocol}-tiny-1" for run in ("SH", "NRF") for protocol in ("original", "mcmc@400")
    }
    parts = {name: record["train"]["parts"] for name, record in records.items()}
    assert parts.pop("NRF-original-tiny-1") == 2 and set(parts.values()) == {1}
    for name, record in records.items():
        train, measured = record["train"], record["measured"]
        assert train["steps"] == 120 and train["seconds"] > 0
        steps = [step for step, _ in train["splats"]]
        assert steps == [0, 100, 119], "the resumed training must count on where it was cut off"
        assert measured["test"]["psnr"] == pytest.approx(record["eval"]["psnr"], abs=1e-4)
        assert len(measured["train"]["per_image"]) == 3 and measured["fps"] > 0
        assert measured["parameter_bytes"] == record["eval"]["parameter_bytes"] < measured["checkpoint_bytes"]
        assert measured["splats"] == train["splats"][-1][1]
        assert str(tmp_path) not in json.dumps(record), "a record must not name places"
        if "mcmc" in name:
            assert measured["splats"] == 400
    table = (tmp_path / "out" / "table.md").read_text()
    assert table.count("| tiny |") == 4 and "interrupted" in table
    assert Image.open(tmp_path / "out" / "crops" / "tiny.png").width > 4 * 220
    assert (tmp_path / "out" / "splats.png").exists()
