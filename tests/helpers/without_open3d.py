# SPDX-License-Identifier: Apache-2.0
"""Hides open3d from the tests and the processes that they start, and shows it to those of nerfstudio's own exporter.

open3d's import needs a library that a fresh Linux machine lacks. Where somebody installed that library, a test that
leans on open3d would pass, and fail on the next machine.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

HIDDEN = str(Path(__file__).resolve().parent / "hidden")
shown: dict[str, ModuleType] = {}
"""What `open3d_shown` imported: its C++ classes can be registered once in a process only."""


def hide_open3d() -> None:
    """From this process, and through PYTHONPATH from its children."""
    sys.path.insert(0, HIDDEN)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [HIDDEN, os.environ.get("PYTHONPATH")]))


@contextmanager
def open3d_shown() -> Iterator[None]:
    """Within it `import open3d` finds the installed package; afterwards it and what imports it are hidden again."""
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
