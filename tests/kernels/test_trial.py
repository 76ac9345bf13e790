# SPDX-License-Identifier: Apache-2.0
"""Trials: which outcomes are remembered; trials beside other work. Neither a GPU nor Triton is needed."""

import threading
from unittest.mock import Mock

import pytest
import torch

from nrfgs_ns.kernels.trial import tried_meanwhile, tried_once

CPU = torch.device("cpu")


def test_an_outcome_is_remembered_and_a_failure_reported_once(caplog):
    sound, broken = Mock(return_value=(1, 2)), Mock(side_effect=OSError("no compiler\nsearched everywhere"))
    for trial, outcome in ((sound, (1, 2)), (broken, None)):
        tried = tried_once("It")(trial)
        assert tried(CPU) == tried(CPU) == outcome
        trial.assert_called_once_with(CPU)
    reports = [record.getMessage() for record in caplog.records]
    assert reports == ["It is slower on cpu: Triton's kernels do not run here (OSError: no compiler)."]


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), KeyboardInterrupt()])
def test_what_says_nothing_about_triton_passes_and_is_not_remembered(error, caplog):
    tried = tried_once("It")(Mock(side_effect=[error, True]))
    with pytest.raises(type(error)):
        tried(CPU)
    assert not caplog.records
    assert tried(CPU)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_trials_have_gradients_in_any_mode(mode):
    @tried_once("It")
    def tried(device):
        x = torch.ones(1, requires_grad=True)
        (x * x).sum().backward()
        return x.grad.item()

    with mode():
        assert tried(CPU) == 2.0
        assert torch.is_inference_mode_enabled() == (mode is torch.inference_mode)


def test_kernels_are_tried_while_something_else_is_done():
    begun, done, tried = threading.Event(), threading.Event(), []

    def trial():
        begun.set()
        assert done.wait(20)
        tried.append("all, whatever went wrong before")

    failing = [Mock(side_effect=torch.OutOfMemoryError("no room")), Mock(side_effect=OSError("no compiler"))]
    with tried_meanwhile([*failing, trial], CPU):
        assert begun.wait(20), "at the same time"
        done.set()
    assert len(tried) == 1
    with pytest.raises(KeyError), tried_meanwhile([lambda: tried.append("joined after an error, too")], CPU):
        raise KeyError
    assert len(tried) == 2
