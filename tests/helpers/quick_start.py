# SPDX-License-Identifier: Apache-2.0
"""What makes the start of a process of tests, and of each training in it, quick."""

import gc
import sys
from types import SimpleNamespace

from nerfstudio.configs import external_methods

FREEZE, UNFREEZE = gc.freeze, gc.unfreeze


def ask_for_callers_quickly() -> None:
    """Before `nerfstudio.configs.method_configs` is imported: let it know its callers by name alone.

    It asks 26 times for the function two calls up, by inspect.stack(), which looks for the source of every frame in
    every module: a second or two, and six below pytest's many frames.
    """

    def stack() -> list[SimpleNamespace]:
        """Names of the functions that are running, the caller's first, as inspect.stack() has them."""
        frame, frames = sys._getframe(1), []
        while frame is not None:
            frames.append(SimpleNamespace(function=frame.f_code.co_name))
            frame = frame.f_back
        return frames

    external_methods.inspect = SimpleNamespace(stack=stack)


def keep_what_is_imported() -> None:
    """Keep the garbage collector off what there is, hundreds of thousands of objects, until `let_go`.

    Each training would walk through them, freeze them and thaw them again, which takes as long as ten of its steps.
    That it does is what `test_lifecycle.py` looks at.
    """
    gc.collect()
    FREEZE()
    gc.freeze = gc.unfreeze = lambda: None


def let_go() -> None:
    """Give everything back to the garbage collector: bindings in C++ complain of what is left when Python ends."""
    gc.freeze, gc.unfreeze = FREEZE, UNFREEZE
    UNFREEZE()
