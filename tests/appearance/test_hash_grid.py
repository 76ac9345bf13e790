# SPDX-License-Identifier: Apache-2.0
"""The hash grid's kernels (hash_grid_interpreted.py, in a process of its own), and when they are not taken. What the
grid computes: test_vdgs.py."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hash_grid_cases import grids, positions

from nrfgs_ns.appearance import hash_grid

INTERPRETED = Path(__file__).with_name("hash_grid_interpreted.py")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
def test_kernels_in_the_interpreter():
    """Every test of hash_grid_interpreted.py; a failure shows that process's report."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(INTERPRETED)]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=INTERPRETED.parents[2])
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]


def test_cpu_takes_torch():
    grid, twin = grids()
    x = positions(20)
    assert torch.equal(grid(x), grid.in_torch(x)) and torch.equal(twin(x.double()), twin.in_torch(x.double()))
    assert hash_grid._RUNS == {}  # it was not even asked whether Triton runs


def test_without_triton_a_warning_and_torch(monkeypatch, caplog):
    monkeypatch.setattr(hash_grid, "_RUNS", {})
    monkeypatch.setattr(hash_grid.importlib.util, "find_spec", lambda name: None)
    assert not hash_grid._kernels_run_on(torch.device("cpu"), 4)
    assert not hash_grid._kernels_run_on(torch.device("cpu"), 4)
    assert [record.getMessage() for record in caplog.records] == [
        "The hash grid runs in plain PyTorch on cpu: Triton is not installed."
    ]
