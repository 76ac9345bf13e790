# SPDX-License-Identifier: Apache-2.0
"""Adam's kernel in Triton's interpreter against torch's Adam."""

from copy import deepcopy

import pytest
import quick_interpreter  # noqa: F401
import torch
from torch.testing import assert_close

from nrfgs_ns.training import adam_triton
from nrfgs_ns.training.adam_triton import AdamTable

CPU = torch.device("cpu")
OPTIONS = (
    {"lr": 0.1, "betas": (0.5, 0.9)},
    {"lr": 1e-3, "weight_decay": 0.1},
    {"lr": 1e-6, "eps": 1e-15},
    {"lr": 5e-2, "betas": (0.0, 0.99)},
)


def adam(shape, **options) -> torch.optim.Adam:
    """Adam of one random parameter, with its state."""
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.randn(shape))], **options)
    (parameter,) = optimizer.param_groups[0]["params"]
    zeros = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
    optimizer.state[parameter] = {"step": torch.tensor(0.0), **zeros}
    return optimizer


def work_of(optimizers) -> list:
    """What `AdamTable.step` takes; the steps are counted."""
    for optimizer in optimizers:
        for state in optimizer.state.values():
            state["step"] += 1
    return [(o.param_groups[0], *next(iter(o.state.items()))) for o in optimizers]


def numbers_of(optimizer) -> list[torch.Tensor]:
    """A copy of an optimiser's parameter and its state."""
    (parameter,) = optimizer.param_groups[0]["params"]
    return [value.detach().clone() for value in (parameter, *optimizer.state[parameter].values())]


def test_steps_are_torchs(monkeypatch):
    """Tensors of a block, of several and of part of one, each with its own options, counter and size of gradients; one
    begins later, one is replaced, a rate falls."""
    monkeypatch.setattr(adam_triton, "BLOCK", 64)
    torch.manual_seed(0)
    mine = [adam(shape, **options) for shape, options in zip([(70, 3), (5,), (64,), (1,)], OPTIONS, strict=True)]
    theirs, table = deepcopy(mine), AdamTable(CPU)
    for turn in range(4):
        stepping = [i for i in range(4) if i != 1 or turn > 0]
        if turn == 2:
            mine[2] = adam((9, 9), **OPTIONS[2])
            theirs[2] = deepcopy(mine[2])
            mine[0].param_groups[0]["lr"] = theirs[0].param_groups[0]["lr"] = 0.01
        for i in stepping:
            gradient = torch.randn_like(mine[i].param_groups[0]["params"][0]) * 10.0 ** (3 * i - 6)
            for side in (mine, theirs):
                side[i].param_groups[0]["params"][0].grad = gradient.clone()
            theirs[i].step()
        with torch.no_grad():
            assert table.step(work_of([mine[i] for i in stepping]), None)
        for i, (left, right) in enumerate(zip(mine, theirs, strict=True)):
            size = 10.0 ** (3 * i - 6)
            scales = OPTIONS[i]["lr"], 0.0, size, size**2  # of a step, its number, and the means, which may cancel
            for a, b, scale in zip(numbers_of(left), numbers_of(right), scales, strict=True):
                assert_close(a, b, rtol=3e-7, atol=3e-7 * scale)


def test_a_skipped_step_changes_nothing():
    torch.manual_seed(0)
    optimizers = [adam((7, 3), lr=0.1), adam((4,), lr=0.1)]
    for parameter in (optimizer.param_groups[0]["params"][0] for optimizer in optimizers):
        parameter.grad = torch.full_like(parameter, float("nan"))
    before = [number for optimizer in optimizers for number in numbers_of(optimizer)]
    with torch.no_grad():
        assert AdamTable(CPU).step(work_of(optimizers), torch.tensor(1.0))
    assert all(map(torch.equal, before, (number for optimizer in optimizers for number in numbers_of(optimizer))))


@pytest.mark.parametrize("what", ["float64", "gradient of another layout", "too many"])
def test_what_the_kernel_does_not_take(what):
    optimizers = [adam((4, 4), lr=0.1) for _ in range(adam_triton.COLUMNS + 1 if what == "too many" else 1)]
    (parameter,) = optimizers[0].param_groups[0]["params"]
    if what == "float64":
        parameter.data = parameter.data.double()
    for optimizer in optimizers:
        (each,) = optimizer.param_groups[0]["params"]
        each.grad = torch.ones_like(each)
    if what == "gradient of another layout":
        parameter.grad = torch.ones(4, 8)[:, ::2]
    with torch.no_grad():
        taken = AdamTable(CPU).step(work_of(optimizers), None)
    assert not taken
