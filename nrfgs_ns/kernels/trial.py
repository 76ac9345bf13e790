# SPDX-License-Identifier: Apache-2.0
"""Trials of Triton's kernels: Triton or a C compiler may be missing, or the device may have too little shared memory.

Nothing here imports Triton; trials do.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import cache, wraps
from typing import Any, TypeVar

import torch

Trial = TypeVar("Trial", bound=Callable[[torch.device], Any])

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


def tried_once(what: str) -> Callable[[Trial], Trial]:
    """Let a trial of kernels on a device be made once, which compiles them, and its outcome be remembered.

    The trial has gradients whatever mode the caller is in. If it raises, the outcome is None, and a warning says why.
    Out-of-memory says nothing about Triton: it is raised, and not remembered.

    Args:
        what: the subject of the warning "... is slower".
    """

    def with_memory(trial: Trial) -> Trial:
        @cache
        @wraps(trial)
        def tried(device: torch.device) -> Any:
            try:
                with torch.inference_mode(False), torch.enable_grad():
                    return trial(device)
            except torch.OutOfMemoryError:
                raise
            except Exception as error:
                first_line = next(iter(str(error).splitlines()), "")
                reason = f"Triton's kernels do not run here ({type(error).__name__}: {first_line})"
                logger.warning("%s is slower on %s: %s.", what, device, reason)
                return None

        return tried

    return with_memory
