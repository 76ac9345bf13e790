# SPDX-License-Identifier: Apache-2.0
"""A quicker and quieter start of nerfstudio's commands. Nothing here imports torch's compiler or nerfstudio's models.

Nerfstudio imports this package twice: for its data parsers, before most other imports, and for its methods, right
before it lists external ones and reads the command line. It offers no hook for either replacement below; `host.py` has
their names.
"""

import atexit
import functools
import gc
import sys
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NoReturn

from nerfstudio.configs import external_methods
from nerfstudio.utils import misc
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.errors import DEBUG, mind_the_reader


def with_data_parsers() -> None:
    """Speed up nerfstudio's next imports; silence their deprecation warnings unless NRFGS_DEBUG=1."""
    gc.freeze()  # imported objects stay: the collector need not visit them
    atexit.register(gc.unfreeze)  # frozen objects are not destroyed in order, and Triton's bindings complain
    mind_the_reader()
    CONSOLE.on_broken_pipe = _reader_is_gone
    if not DEBUG:
        warnings.filterwarnings("ignore", category=FutureWarning, module=r"(torch|nerfstudio)(\.|$)")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a path that the terminal's encoding lacks must not end a training
            stream.reconfigure(errors="backslashreplace")
    if not hasattr(misc.torch_compile, "__wrapped__"):
        misc.torch_compile = _compile_when_called(misc.torch_compile)


def with_methods() -> None:
    """Speed up nerfstudio's work before it reads the command line."""
    gc.freeze()
    external_methods.inspect = SimpleNamespace(stack=_callers)


def _reader_is_gone() -> NoReturn:
    """An error, with which a training is saved; rich's own ends the process."""
    raise BrokenPipeError("nobody reads the output on")


def _compile_when_called(torch_compile: Callable) -> Callable:
    """Nerfstudio's `torch_compile`; as a decorator it compiles at the function's first call: importing torch's
    compiler, for one function of splatfacto's, is a tenth of a command's start."""

    @functools.wraps(torch_compile)
    def decorator_or_compiled(*args: Any, **options: Any) -> Any:
        if args:
            return torch_compile(*args, **options)

        def decorate(function: Callable) -> Callable:
            compiled = functools.cache(lambda: torch_compile(**options)(function))
            return functools.wraps(function)(lambda *args, **kwargs: compiled()(*args, **kwargs))

        return decorate

    return decorator_or_compiled


def _callers() -> list[SimpleNamespace]:
    """Names of the caller, its caller and that one's, which nerfstudio asks for 26 times. Its inspect.stack() reads the
    source of every frame: two fifths of a command's start."""
    frame = sys._getframe(1)
    frames = frame, frame.f_back, frame.f_back.f_back
    return [SimpleNamespace(function=frame.f_code.co_name) for frame in frames]
