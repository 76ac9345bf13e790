# SPDX-License-Identifier: Apache-2.0
"""`Gate`: which outcomes of a trial are remembered; trials beside other work. Neither a GPU nor Triton is needed."""

import threading
from unittest.mock import Mock

import pytest
import torch

from nrfgs_ns.kernels import trial
from nrfgs_ns.kernels.trial import Gate, tried_meanwhile

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def triton_is_installed(monkeypatch):
    monkeypatch.setattr(trial.importlib.util, "find_spec", lambda name: name)


def test_an_outcome_is_remembered_and_a_failure_reported_once(caplog, monkeypatch):
    gate = Gate("It")
    assert gate.find("sound", CPU, lambda: (1, 2)) == gate.find("sound", CPU, Mock(side_effect=OSError())) == (1, 2)
    for _ in range(2):
        assert not gate.opens("broken", CPU, Mock(side_effect=OSError("no compiler\nsearched everywhere")))
    assert gate["broken"] == "Triton's kernels do not run here (OSError: no compiler)"
    assert [record.getMessage() for record in caplog.records] == [f"It is slower on cpu: {gate['broken']}."]
    monkeypatch.setattr(trial.importlib.util, "find_spec", lambda name: None)
    assert Gate("It").find("key", CPU, Mock(side_effect=AssertionError("tried"))) == "Triton is not installed"


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), KeyboardInterrupt()])
def test_what_says_nothing_about_triton_passes_and_is_not_remembered(error, caplog):
    gate = Gate("It")
    with pytest.raises(type(error)):
        gate.opens("key", CPU, Mock(side_effect=error))
    assert gate == {} and not caplog.records
    assert gate.opens("key", CPU, lambda: None)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_trials_have_gradients_in_any_mode(mode):
    def trial():
        x = torch.ones(1, requires_grad=True)
        (x * x).sum().backward()
        return x.grad.item()

    with mode():
        assert Gate("It").find("key", CPU, trial) == 2.0
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
