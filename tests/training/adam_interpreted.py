# SPDX-License-Identifier: Apache-2.0
"""Adam's kernel in Triton's interpreter against torch's Adam.

Run by test_optimizers.py in a process of its own: Triton decides when it is imported whether it interprets.
"""

import quick_interpreter  # noqa: F401
import torch
from torch.testing import assert_close

from nrfgs_ns.training import adam_triton
from nrfgs_ns.training.adam_triton import AdamTable, AdamTensor, is_taken

CPU = torch.device("cpu")
OPTIONS = (
    {"lr": 0.1, "betas": (0.5, 0.9)},
    {"lr": 1e-3, "weight_decay": 0.1},
    {"lr": 1e-6, "eps": 1e-15},
    {"lr": 5e-2, "betas": (0.0, 0.99)},
)


def test_steps_are_torchs(monkeypatch):
    """Tensors of a block, of several and of part of one, each with its own options, counter and size of gradients."""
    monkeypatch.setattr(adam_triton, "BLOCK", 64)
    torch.manual_seed(0)
    parameters = [torch.randn(shape) for shape in [(70, 3), (5,), (64,), (1,)]]
    twins = [parameter.clone().requires_grad_() for parameter in parameters]
    optimizers = [torch.optim.Adam([twin], **options) for twin, options in zip(twins, OPTIONS, strict=True)]
    states = [{name: torch.zeros_like(p) for name in ("mean", "square")} for p in parameters]
    steps = [torch.tensor(0.0) for _ in parameters]
    table = AdamTable(CPU)
    for turn in range(3):
        work = []
        for i, (parameter, optimizer) in enumerate(zip(parameters, optimizers, strict=True)):
            if i == 1 and turn == 0:  # begins a step later
                continue
            twins[i].grad = torch.randn_like(parameter) * 10.0 ** (3 * i - 6)
            optimizer.step()
            steps[i] += 1
            gradient = twins[i].grad.clone()
            work.append(AdamTensor(parameter, gradient, **states[i], step=steps[i], group=optimizer.param_groups[0]))
        table.step(work, None)
        for i, (parameter, twin) in enumerate(zip(parameters, twins, strict=True)):
            assert_close(parameter, twin.detach(), rtol=3e-7, atol=3e-7 * OPTIONS[i]["lr"])
    before = [parameter.clone() for parameter in parameters]
    table.step(work, torch.tensor(1.0))
    assert all(map(torch.equal, parameters, before))


def test_what_the_kernel_does_not_take():
    numbers = [torch.ones(8) for _ in range(4)]
    assert is_taken(AdamTensor(*numbers, torch.ones(()), {}), CPU)
    for other in (torch.ones(9)[1:], torch.ones(8, dtype=torch.float64), torch.ones(8, 2)[:, 0]):
        assert not is_taken(AdamTensor(numbers[0], other, *numbers[2:], torch.ones(()), {}), CPU)
