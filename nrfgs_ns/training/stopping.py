# SPDX-License-Identifier: Apache-2.0
"""How a training ends before its last step: by a signal, or because memory has run out.

A first Ctrl-C, SIGTERM or SIGHUP (a closed terminal) lets the current step end, evaluation included, so that the state
on disk is the same as an uninterrupted training's. A second Ctrl-C ends the process at once.
"""

import os
import signal
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from time import monotonic

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.optim import Optimizer

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
PATIENCE = 0.5
"""Seconds within which a second Ctrl-C is the first one, heard twice: from the terminal and from a parent process."""


class StopRequest:
    """A signal's request to stop.

    Attributes:
        signal: the first one received; None: the training goes on.
        is_over: whether the training has ended, so that signals end the process as usual.
    """

    def __init__(self):
        self.signal: signal.Signals | None = None
        self.is_over = False
        self._heard_at = 0.0

    def hear(self, number: int, frame: object = None) -> None:
        """Handle a signal, in the main thread, between two of Python's instructions."""
        if self.is_over:
            raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)
        if self.signal is None:
            self.signal = signal.Signals(number)
            self._heard_at = monotonic()
            if self.signal.name == "SIGHUP":
                _let_go_of_terminal()
            elif not CONSOLE.quiet:
                _say("Stopping when this step is done. Ctrl-C again stops at once, and saves nothing.")
        elif number == signal.SIGINT and monotonic() - self._heard_at > PATIENCE:
            _say("Stopped at once; what was not saved yet is lost.")
            os._exit(128 + number)


@contextmanager
def heard_signals(request: StopRequest) -> Iterator[None]:
    """Let signals make a request instead of ending the process, except those that are ignored (`nohup`)."""
    heard = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, request.hear) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: not one of Python's


def is_out_of_memory(error: BaseException) -> bool:
    """Whether the memory of a GPU or of the host has run out."""
    # torch's allocator of host memory raises a RuntimeError that only its message tells from others.
    return isinstance(error, (torch.OutOfMemoryError, MemoryError)) or "DefaultCPUAllocator: " in str(error)


def rows_agree(splats: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer], counted: Iterable[object]) -> bool:
    """Whether an interrupted state is consistent: each splat has a row in every tensor, including those of the
    optimisers and of densification's statistics, `counted`."""
    tensors = [*splats.values(), *counted]
    for name, parameter in splats.items():
        if optimizers[name].param_groups[0]["params"][0] is not parameter:
            return False
        tensors += optimizers[name].state.get(parameter, {}).values()
    return len({len(value) for value in tensors if isinstance(value, Tensor) and value.dim() > 0}) == 1


def _say(line: str) -> None:
    """Write a line to the terminal from a signal handler, where print may not be called."""
    with suppress(OSError):
        os.write(2, f"\n{line}\n".encode())


def _let_go_of_terminal() -> None:
    """Discard all further output: writing to a terminal that is gone is an error."""
    with open(os.devnull, "r+b") as nowhere:
        for stream in (0, 1, 2):
            os.dup2(nowhere.fileno(), stream)
