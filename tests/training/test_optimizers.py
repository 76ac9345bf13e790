# SPDX-License-Identifier: Apache-2.0
"""The lean optimisers step as torch's own. Their kernel in Triton's interpreter: adam_interpreted.py."""

import warnings

import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from torch.testing import assert_close

from nrfgs_ns.training.optimizers import LeanOptimizers
from nrfgs_ns.training.pace import Pace


@pytest.mark.gpu
def test_all_tensors_in_one_kernel_step_as_torchs():
    """Forty tensors, small and large, and a step that is skipped on the device. The twin is not fused: torch's fused
    Adam takes 1 - beta2^step in float32, 3e-5 off in the first steps."""
    shapes, sides = [(1000, 3), (300_000, 7), *[(size,) for size in range(1, 39)]], []
    for fused in (True, False):
        torch.manual_seed(0)
        parameters = [torch.nn.Parameter(torch.randn(shape, device="cuda")) for shape in shapes]
        rates = [10.0 ** -(1 + i % 4) for i in range(len(shapes))]
        made = [
            torch.optim.Adam([p], lr=rate, eps=1e-15, fused=fused, foreach=False)
            for p, rate in zip(parameters, rates, strict=True)
        ]
        sides.append((parameters, made))
    lean = LeanOptimizers({}, {})
    for step in range(5):
        for parameters, _ in sides:
            torch.manual_seed(step)
            for parameter in parameters:
                parameter.grad = torch.randn_like(parameter)
        verdict = torch.tensor(float(step == 3), device="cuda")
        for mine, theirs in zip(sides[0][1], sides[1][1], strict=True):
            mine.found_inf = verdict
            if step == 0:  # in which torch makes the state
                mine.step()
            if step != 3:
                theirs.step()
        if step > 0:
            assert lean.step_at_once(sides[0][1])
    for rate, mine, theirs in zip(rates, *(side[0] for side in sides), strict=True):
        assert_close(mine, theirs, rtol=1e-6, atol=1e-4 * rate)  # the first step is torch's fused one
    for mine, theirs in zip(*(side[1] for side in sides), strict=True):
        assert next(iter(mine.state.values()))["step"] == next(iter(theirs.state.values()))["step"] == 4


def group(fused: bool, pace: Pace | None = None):
    """Nerfstudio's optimisers over one parameter; on a CPU fused has to be asked for."""
    decay = ExponentialDecaySchedulerConfig(lr_final=0.001, max_steps=10)
    config = {"means": {"optimizer": AdamOptimizerConfig(lr=0.1, eps=1e-15), "scheduler": decay}}
    torch.manual_seed(0)
    parameter = torch.nn.Parameter(torch.randn(5, 3))
    optimizers = LeanOptimizers(config, {"means": [parameter]}, pace=pace)
    for settings in optimizers.optimizers["means"].param_groups:
        settings["fused"] = True if fused else None
    return parameter, optimizers


def test_training_with_a_schedule_is_nerfstudios():
    """Also where the first gradient comes late."""
    results = []
    for fused in (True, False):
        parameter, optimizers = group(fused)
        first = parameter.detach().clone()
        for step in range(6):
            optimizers.zero_grad_all()
            assert parameter.grad is None
            if step > 0:
                (parameter - 1).square().sum().backward()
            optimizers.step()
            assert torch.equal(parameter, first) == (step == 0)
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # torch warns if a schedule runs ahead of its optimiser
                optimizers.scheduler_step_all(step)
        results.append(parameter.detach())
    assert_close(*results)


def test_learning_rates_are_those_of_the_position():
    """Step s of N has the learning rate of step s L / N of the L that the schedule is laid out for."""
    _, optimizers = group(fused=False, pace=Pace(10, rate=0.25))
    optimizers.step()  # torch warns if a schedule runs ahead of its optimiser
    rates = []
    for step in range(40):
        rates.append(optimizers.optimizers["means"].param_groups[0]["lr"])
        optimizers.scheduler_step_all(step)
    assert rates == pytest.approx([0.1 * 0.01 ** (0.25 * step / 10) for step in range(40)])


def test_a_loaded_state_is_moved_to_what_the_optimiser_runs_on():
    parameter, optimizers = group(fused=False)
    parameter.square().sum().backward()
    optimizers.step()
    state = {name: optimizer.state_dict() for name, optimizer in optimizers.optimizers.items()}
    state["means"]["param_groups"][0]["fused"] = True  # as written on a GPU
    other, loaded = group(fused=False)
    loaded.load_optimizers(state)
    assert not loaded.optimizers["means"].param_groups[0]["fused"]
    assert not loaded.all_fused
    other.square().sum().backward()
    loaded.step()
    assert loaded.optimizers["means"].state[other]["step"] == 2
