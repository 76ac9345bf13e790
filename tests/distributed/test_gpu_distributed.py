# SPDX-License-Identifier: Apache-2.0
"""Two GPUs with NCCL between them: the step of one process, and a training that densifies."""

import pytest
import torch
from torch.testing import assert_close

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs"),
]

TOLERANCE = 1e-3
"""Of the largest entry of a tensor. The kernels add float32 numbers in no particular order: entries are sums of up to
P = 5e5 products (`test_step.py`), whose rounding adds up like a random walk to sqrt(P) eps = 4e-5 of their sizes.
Cancellation makes sizes larger than sums, for which 25 is allowed. A gradient that were lost or doubled would be wrong
by 0.5."""


@pytest.fixture(scope="module")
def results(run_together):
    return run_together("fits_one_process", device_type="cuda")


def test_step(results):
    first, second, alone = (torch.load(results / f"step-{who}.pt", map_location="cpu") for who in (0, 1, "alone"))
    for rank, ours in enumerate((first, second)):
        agree("rgb", ours["rgb"], alone["rgb"][rank])
        for name, theirs in alone["gradients"].items():
            if name != "quats":  # the first splats are round: their rotation has no gradient
                agree(name, ours["gradients"][name], theirs[rank::2])
        for name, theirs in alone["shared"].items():
            if theirs is not None:
                agree(name, ours["shared"][name], theirs)
        for name, theirs in alone["statistics"].items():
            agree(name, ours["statistics"][name], theirs[rank::2])


def agree(name, ours, theirs) -> None:
    bound = TOLERANCE * float(theirs.abs().max())
    assert_close(ours, theirs, rtol=0.0, atol=bound, msg=lambda text: f"{name}: {text}")


def test_fifty_steps(results):
    first, second = (torch.load(results / f"fifty-{rank}.pt") for rank in (0, 1))
    assert sum(first["counts"][-1][2]) > 300
    assert first["counts"][-1][2] == second["counts"][-1][2] == [first["counts"][-1][1], second["counts"][-1][1]]
