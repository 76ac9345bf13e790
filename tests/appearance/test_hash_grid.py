# SPDX-License-Identifier: Apache-2.0
"""When the hash grid's kernels are not taken. The kernels: hash_grid_interpreted.py. What the grid computes:
test_vdgs.py."""

import torch
from hash_grid_cases import grids, positions

from nrfgs_ns.appearance import hash_grid
from nrfgs_ns.kernels import trial
from nrfgs_ns.kernels.trial import Gate


def test_cpu_takes_torch():
    grid, twin = grids()
    x = positions(20)
    assert torch.equal(grid(x), grid.in_torch(x)) and torch.equal(twin(x.double()), twin.in_torch(x.double()))
    assert hash_grid._GATE == {}  # it was not even asked whether Triton runs


def test_without_triton_a_warning_and_torch(monkeypatch, caplog):
    monkeypatch.setattr(hash_grid, "_GATE", Gate("The hash grid"))
    monkeypatch.setattr(trial.importlib.util, "find_spec", lambda name: None)
    assert not hash_grid._kernels_run_on(torch.device("cpu"), 4)
    assert not hash_grid._kernels_run_on(torch.device("cpu"), 4)
    assert [record.getMessage() for record in caplog.records] == [
        "The hash grid runs in plain PyTorch on cpu: Triton is not installed."
    ]
