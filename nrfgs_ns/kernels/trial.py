# SPDX-License-Identifier: Apache-2.0
"""Whether Triton's kernels run here, found out by running them: Triton may be missing, or the C compiler that its
launcher is built with, or the device may have less shared memory than a kernel takes.

Nothing here imports Triton: it is missing on machines without CUDA. Trials do, once it is known to be there.
"""

import importlib.util
from collections.abc import Callable
from typing import TypeVar

import torch

Outcome = TypeVar("Outcome")


def try_triton(trial: Callable[[], Outcome]) -> Outcome | str:
    """What the trial returns, or why Triton's kernels do not run here, for after a colon.

    Args:
        trial: imports and runs kernels, with gradients if it likes, whatever mode the caller is in; raises what goes
            wrong. Whatever it is, PyTorch computes the same.

    Raises:
        torch.OutOfMemoryError: memory ran out in the trial. That says nothing about Triton and is not to be remembered;
            PyTorch's path would need more memory still.
    """
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
