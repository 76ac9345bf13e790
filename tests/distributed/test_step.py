# SPDX-License-Identifier: Apache-2.0
"""One step of two devices against the same step of one process, value for value, in float64.

Both do the same arithmetic on the same numbers; only the order of sums differs. An image's and a gradient's entry is a
sum of at most P = 48 x 36 pixels x 300 splats = 5e5 products, so that rounding moves it by at most P eps = 1.2e-10 of
the sum of the products' sizes. Cancellation makes that sum larger than the largest entry of its tensor by a factor,
for which 100 is allowed: 1e-8 of the largest entry. A gradient that were lost, doubled or given to another splat would
be wrong by 1e-3 of it or more.
"""

from unittest.mock import Mock, patch

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from nrfgs_ns.densification import CHANGE
from nrfgs_ns.distributed import comm
from nrfgs_ns.distributed.model import own_rows

RELATIVE = 1e-8


def agree(name, ours, theirs, relative: float = RELATIVE) -> None:
    assert_close(ours, theirs, rtol=0.0, atol=relative * float(theirs.abs().max()), msg=lambda text: f"{name}: {text}")


@pytest.fixture(params=["plain", "rich", "pixels"])
def results(request, two_devices):
    """(device 0, device 1, one process) of a step: `plain` is splatfacto's densification with absgrad and the largest
    changes of opacity; `rich` has antialiasing, learnt poses, and losses over splats (MCMC's). The two cameras differ
    in size. `pixels` is `plain` with a head at the pixel."""
    return tuple(torch.load(two_devices / f"{request.param}-{who}.pt") for who in (0, 1, "alone"))


def test_every_device_renders_its_own_camera_and_has_its_loss(results):
    first, second, alone = results
    assert first["rgb"].shape != second["rgb"].shape
    for ours, theirs in zip((first, second), alone["rgb"], strict=True):
        agree("rgb", ours["rgb"], theirs)
        assert float(theirs.std()) > 0.02, "an image without contents proves nothing"
    for name in alone["losses"][0]:
        mine, theirs = torch.stack([part["losses"][name] for part in (first, second)]), alone["losses"]
        theirs = torch.stack([losses[name] for losses in theirs])
        if name.startswith(("mcmc", "shrink")):  # a mean over splats: each device has its part
            mine, theirs = mine.mean(), theirs.mean()
        agree(name, mine, theirs)


def test_gradients_of_splats_arrive_where_they_live_and_those_of_shared_weights_are_whole(results):
    first, second, alone = results
    assert alone["gradients"].keys() == first["gradients"].keys()
    for name, theirs in alone["gradients"].items():
        assert float(theirs.abs().max()) > 0, name
        for rank, ours in enumerate((first, second)):
            agree(name, ours["splats"][name], alone["splats"][name][rank::2])
            agree(name, ours["gradients"][name], theirs[rank::2])
    for name, theirs in alone["shared"].items():
        for ours in (first, second):
            assert (ours["shared"][name] is None) == (theirs is None), name
            if theirs is not None:
                agree(name, ours["shared"][name], theirs)
    learning = [name for name, value in alone["shared"].items() if value is not None and float(value.abs().max()) > 0]
    assert any("head" in name for name in learning)
    if any("camera_opt" in name for name in alone["shared"]):
        assert any("camera_opt" in name for name in learning)


def test_statistics_of_densification_are_those_of_single_views(results):
    """Gradients are counted for each view by itself, though the loss is a mean: thresholds mean the same."""
    first, second, alone = results
    for name, theirs in alone["statistics"].items():
        for rank, ours in enumerate((first, second)):
            agree(name, ours["statistics"][name].double(), theirs[rank::2].double())
    if "grad2d" in alone["statistics"]:
        assert {"grad2d", "count", "radii", CHANGE} <= alone["statistics"].keys()
        assert float(alone["statistics"]["count"].max()) == 2, "no splat is seen by both cameras"


@given(st.integers(0, 50), st.integers(1, 8))
def test_every_row_has_one_device(total, devices):
    parts = []
    for rank in range(devices):
        with patch.multiple(comm, rank=Mock(return_value=rank), world=Mock(return_value=devices)):
            parts.append(own_rows(torch.arange(total)).tolist())
    assert sorted(row for part in parts for row in part) == list(range(total))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


# Two GPUs with NCCL between them: the step of one process, and a training that densifies.
def gpus(test):
    return pytest.mark.gpu(pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")(test))


TOLERANCE = 1e-3
"""Of the largest entry of a tensor. The kernels add float32 numbers in no particular order: entries are sums of up to
P = 5e5 products (above), whose rounding adds up like a random walk to sqrt(P) eps = 4e-5 of their sizes.
Cancellation makes sizes larger than sums, for which 25 is allowed. A gradient that were lost or doubled would be wrong
by 0.5."""


@gpus
def test_step_on_gpus(on_gpus):
    first, second, alone = (torch.load(on_gpus / f"step-{who}.pt", map_location="cpu") for who in (0, 1, "alone"))
    for rank, ours in enumerate((first, second)):
        agree("rgb", ours["rgb"], alone["rgb"][rank], TOLERANCE)
        for name, theirs in alone["gradients"].items():
            if name != "quats":  # the first splats are round: their rotation has no gradient
                agree(name, ours["gradients"][name], theirs[rank::2], TOLERANCE)
        for name, theirs in alone["shared"].items():
            if theirs is not None:
                agree(name, ours["shared"][name], theirs, TOLERANCE)
        for name, theirs in alone["statistics"].items():
            agree(name, ours["statistics"][name], theirs[rank::2], TOLERANCE)


@gpus
def test_thirty_steps_on_gpus(on_gpus):
    first, second = (torch.load(on_gpus / f"thirty-{rank}.pt") for rank in (0, 1))
    assert sum(first["counts"][-1][2]) > 300
    assert first["counts"][-1][2] == second["counts"][-1][2] == [first["counts"][-1][1], second["counts"][-1][1]]
