# SPDX-License-Identifier: Apache-2.0
"""Trials of Triton's kernels: Triton or a C compiler may be missing, or the device may have too little shared memory.

Nothing here imports Triton; trials do, once it is known to be there.
"""

import importlib.util
import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial, wraps
from typing import Any, TypeVar

import torch

Outcome = TypeVar("Outcome")

logger = logging.getLogger(__name__)


@contextmanager
def tried_meanwhile(trials: Sequence[Callable[[], object]], device: torch.device) -> Iterator[None]:
    """Try kernels, which compiles them, on a thread of its own while the block runs; joined at its end.

    Errors are not reported here: the first use of the kernels meets them again.
    """

    def run(trial: Callable[[], object]) -> None:
        with torch.cuda.device(device) if device.type == "cuda" else nullcontext():  # each thread has its own
            trial()

    with ThreadPoolExecutor(1, "kernels") as pool:
        for trial in trials:
            pool.submit(run, trial)
        yield


class Gate(dict[Hashable, Any]):
    """Outcomes of kernels' trials: each key is tried once, and a failure reported once.

    Args:
        what: the subject of the warning "... is slower".
    """

    def __init__(self, what: str):
        super().__init__()
        self.what = what

    def find(
        self, key: Hashable, device: torch.device, trial: Callable[[], Outcome], quiet: bool = False
    ) -> Outcome | str:
        """The trial's result, or why the kernels do not run here, for after a colon.

        Args:
            key: what the answer holds for.
            device: for the warning.
            trial: imports and runs kernels, with gradients whatever mode the caller is in; raises what goes wrong, or
                returns a reason.
            quiet: do not warn.

        Raises:
            torch.OutOfMemoryError: that says nothing about Triton and is not remembered.
        """
        if key not in self:
            self[key] = _tried(trial)
            if isinstance(self[key], str) and not quiet:
                logger.warning("%s is slower on %s: %s.", self.what, device, self[key])
        return self[key]

    def opens(self, key: Hashable, device: torch.device, trial: Callable[[], object]) -> bool:
        """Whether the kernels run."""
        return not isinstance(self.find(key, device, trial), str)


def tried_once(what: str) -> Callable[[Callable[[torch.device], object]], Callable[[torch.device], bool]]:
    """Turn a trial of kernels into the question whether they run on a device: it is tried once, which compiles them.

    Args:
        what: as `Gate`'s.
    """
    gate = Gate(what)

    def question(trial: Callable[[torch.device], object]) -> Callable[[torch.device], bool]:
        return wraps(trial)(lambda device: gate.opens(device, device, partial(trial, device)))

    return question


def _tried(trial: Callable[[], Outcome]) -> Outcome | str:
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    try:
        with torch.inference_mode(False), torch.enable_grad():
            return trial()
    except torch.OutOfMemoryError:
        raise
    except Exception as error:
        first_line = next(iter(str(error).splitlines()), "")
        return f"Triton's kernels do not run here ({type(error).__name__}: {first_line})"
