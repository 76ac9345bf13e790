# SPDX-License-Identifier: Apache-2.0
"""`try_triton`: what is a verdict about Triton and what is not, and that its callers remember nothing else. No GPU is
needed for that, nor Triton."""

import threading

import pytest
import torch

from nrfgs_ns.kernels import trial
from nrfgs_ns.kernels.trial import Gate, tried_meanwhile, try_triton

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def triton_is_installed(monkeypatch):
    monkeypatch.setattr(trial.importlib.util, "find_spec", lambda name: name)


def raises(error: BaseException):
    def trial(*_, **__):
        raise error

    return trial


def test_what_the_trial_returns():
    assert try_triton(lambda: None) is None
    assert try_triton(lambda: (1, 2)) == (1, 2)


def test_without_triton_nothing_is_tried(monkeypatch):
    monkeypatch.setattr(trial.importlib.util, "find_spec", lambda name: None)
    assert try_triton(raises(AssertionError("tried"))) == "Triton is not installed"


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), KeyboardInterrupt()])
def test_what_is_no_verdict_passes(error):
    with pytest.raises(type(error)):
        try_triton(raises(error))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_gradients_whatever_the_caller_does_without(mode):
    def trial():
        x = torch.ones(1, requires_grad=True)
        (x * x).sum().backward()
        return x.grad.item()

    with mode():
        assert try_triton(trial) == 2.0
        assert torch.is_inference_mode_enabled() == (mode is torch.inference_mode)
        assert not torch.is_grad_enabled()


def test_memory_that_is_out_is_not_remembered(caplog):
    gate = Gate("It")
    with pytest.raises(torch.OutOfMemoryError):
        gate.opens("key", CPU, raises(torch.OutOfMemoryError("CUDA out of memory")))
    assert gate == {} and not caplog.records
    assert gate.opens("key", CPU, lambda: None)


def test_kernels_are_tried_while_something_else_is_done():
    begun, done, tried = threading.Event(), threading.Event(), []

    def trial():
        begun.set()
        assert done.wait(20)
        tried.append(threading.current_thread().name)

    with tried_meanwhile([raises(torch.OutOfMemoryError("no room")), raises(OSError("no compiler")), trial], CPU):
        assert begun.wait(20), "at the same time"
        done.set()
    assert tried == ["kernels"], "all have been tried, whatever went wrong"
    with pytest.raises(KeyError), tried_meanwhile([lambda: tried.append("again")], CPU):
        raise KeyError
    assert tried == ["kernels", "again"]
    with tried_meanwhile([], CPU):
        assert all(thread.name != "kernels" for thread in threading.enumerate())
