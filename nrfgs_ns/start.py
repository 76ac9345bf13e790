# SPDX-License-Identifier: Apache-2.0
"""What makes nerfstudio's commands start sooner. Nothing here imports torch's compiler or nerfstudio's models.

Nerfstudio imports this package twice: for its data parsers, when most is yet to be imported, and for its methods, right
before it asks for external ones and reads the command line.
"""

import atexit
import functools
import gc
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from nerfstudio.configs import external_methods
from nerfstudio.utils import misc


def with_data_parsers() -> None:
    """Make what nerfstudio imports next come sooner."""
    _leave_modules_alone()
    atexit.register(gc.unfreeze)  # what is frozen is not taken down in order at the end, and Triton's bindings complain
    if not hasattr(misc.torch_compile, "__wrapped__"):
        misc.torch_compile = _compile_when_called(misc.torch_compile)


def with_methods() -> None:
    """Make what nerfstudio does before it reads the command line come sooner."""
    _leave_modules_alone()
    external_methods.inspect = SimpleNamespace(stack=_names_of_callers)


def _leave_modules_alone() -> None:
    """Keep the garbage collector off what has been imported, which stays."""
    gc.freeze()


def _compile_when_called(torch_compile: Callable) -> Callable:
    """Nerfstudio's `torch_compile`, which as a decorator waits for the function's first call.

    torch.compile imports torch's compiler, a tenth of the time that a command takes to start, for one function of
    splatfacto's.
    """

    @functools.wraps(torch_compile)
    def decorator_or_compiled(*args: Any, **options: Any) -> Any:
        if args:
            return torch_compile(*args, **options)

        def decorate(function: Callable) -> Callable:
            compiled = functools.cache(lambda: torch_compile(**options)(function))
            return functools.wraps(function)(lambda *args, **kwargs: compiled()(*args, **kwargs))

        return decorate

    return decorator_or_compiled


def _names_of_callers() -> list[SimpleNamespace]:
    """Names of the functions that are running, the caller's first, as inspect.stack() has them.

    When nerfstudio lists the methods that could be installed, it asks 26 times for the function two calls up, by
    inspect.stack(), which looks for the source of every frame in every module: two fifths of the time that a command
    takes to start, for nothing but the names.
    """
    frame, frames = sys._getframe(1), []
    while frame is not None:
        frames.append(SimpleNamespace(function=frame.f_code.co_name))
        frame = frame.f_back
    return frames
