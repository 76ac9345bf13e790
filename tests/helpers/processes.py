# SPDX-License-Identifier: Apache-2.0
"""Hides open3d from the tests and the processes that they start, and shows it to those of nerfstudio's own exporter.

Its import needs a library that a fresh Linux machine lacks. A test that leans on it would pass where somebody installed
that library, and fail on the next machine.
"""

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

HIDDEN = str(Path(__file__).resolve().parent / "hidden")
shown: dict[str, ModuleType] = {}
"""Modules that `open3d_shown` imported: open3d's C++ classes can be registered once in a process only."""


def hide_open3d() -> None:
    """Hide it from this process, and through PYTHONPATH from its children."""
    sys.path.insert(0, HIDDEN)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [HIDDEN, os.environ.get("PYTHONPATH")]))


@contextmanager
def open3d_shown() -> Iterator[None]:
    """Let `import open3d` find the installed package in a block; afterwards it and what imports it are hidden again."""
    place = sys.path.index(HIDDEN)
    sys.path.remove(HIDDEN)
    sys.modules.update(shown)
    try:
        yield
    finally:
        sys.path.insert(place, HIDDEN)
        for name in list(sys.modules):
            if name.split(".")[0] == "open3d" or name == "nerfstudio.scripts.exporter":
                shown[name] = sys.modules.pop(name)


# A quick start of each training in a process of tests.
FREEZE, UNFREEZE = gc.freeze, gc.unfreeze


def keep_what_is_imported() -> None:
    """Keep the garbage collector off all that is imported, until `let_go`.

    Each training would walk through hundreds of thousands of objects, freeze them and thaw them again, which takes as
    long as ten of its steps. `test_lifecycle.py` checks that it does.
    """
    gc.collect()
    FREEZE()
    gc.freeze = gc.unfreeze = lambda: None


def let_go() -> None:
    """Give everything back to the garbage collector: bindings in C++ complain of what is left when Python ends."""
    gc.freeze, gc.unfreeze = FREEZE, UNFREEZE
    UNFREEZE()
