# SPDX-License-Identifier: Apache-2.0
"""What signals ask for, what can be saved, and the command that goes on."""

import os
import signal

import pytest
import torch

from nrfgs_ns.training import stopping
from nrfgs_ns.training.stopping import StopRequest, heard_signals, is_out_of_memory, rows_agree


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_a_request_and_handlers_are_given_back(number, capfd):
    request, before = StopRequest(), signal.getsignal(number)
    with heard_signals(request):
        assert request.signal is None
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)  # the same one, heard twice
        assert request.signal == number
    assert signal.getsignal(number) is before
    assert capfd.readouterr().err.count("Stopping when this step is done") == 1


def test_what_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        request = StopRequest()
        with heard_signals(request):
            os.kill(os.getpid(), signal.SIGHUP)
        assert request.signal is None
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    ("second", "seconds", "ends"),
    [(signal.SIGINT, 0.1, False), (signal.SIGINT, 2.0, True), (signal.SIGTERM, 2.0, False)],
)
def test_only_a_second_ctrl_c_stops_at_once(second, seconds, ends, monkeypatch):
    """A first one that is heard twice, from the terminal and from a parent process, is no second one."""
    now, ended = [5.0], []
    monkeypatch.setattr(stopping, "monotonic", lambda: now[0])
    monkeypatch.setattr(os, "_exit", ended.append)
    request = StopRequest(quiet=True)
    request.hear(signal.SIGINT)
    now[0] += seconds
    request.hear(second)
    assert ended == ([130] if ends else [])


def test_memory_that_ran_out_is_known():
    assert is_out_of_memory(torch.OutOfMemoryError("CUDA out of memory."))
    with pytest.raises(RuntimeError) as found:
        torch.empty(2**60)
    assert is_out_of_memory(found.value)
    assert not is_out_of_memory(RuntimeError("size mismatch")) and not is_out_of_memory(KeyboardInterrupt())


def table(rows: int):
    splats = {name: torch.nn.Parameter(torch.zeros(rows, 3)) for name in ("means", "scales")}
    optimizers = {name: torch.optim.Adam([value]) for name, value in splats.items()}
    for name, value in splats.items():
        value.grad = torch.ones_like(value)
        optimizers[name].step()
    return splats, optimizers


def test_a_table_that_is_half_changed_is_known():
    splats, optimizers = table(5)
    assert rows_agree(splats, optimizers, [torch.zeros(5), None, 0.5, torch.tensor(3)])
    assert not rows_agree(splats, optimizers, [torch.zeros(6)])
    longer = torch.nn.Parameter(torch.zeros(6, 3))
    assert not rows_agree({**splats, "means": longer}, optimizers, [])
    assert not rows_agree({name: torch.nn.Parameter(torch.zeros(6, 3)) for name in splats}, optimizers, [])
    optimizers["scales"].state[splats["scales"]]["exp_avg"] = torch.zeros(4, 3)
    assert not rows_agree(splats, optimizers, [])
