# SPDX-License-Identifier: Apache-2.0
"""Files that are complete or absent."""

import contextlib
import os
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

from nrfgs_ns.errors import InputError, refusing


def check_writable(path: Path, option: str) -> None:
    """Raise InputError, before a command's work, where a file cannot be written. `option` named the file."""
    with refusing(f"{option} {path} cannot be written", "Name a file in a folder of yours.", OSError):
        if path.exists() and not path.is_file():  # a device would be replaced
            raise InputError(f"{option} {path} is a folder or a device. Name a file.")
        folder = next(folder for folder in path.parents if folder.exists())
        with tempfile.NamedTemporaryFile(dir=folder, prefix=f"{path.name}.", suffix=".writing"):
            pass


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file aside and move it into place: readers find all of it or none. Text is UTF-8."""
    with whole(path) as aside:
        aside.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file of its own for each writer, moved to `path` when the block ends, and removed if it fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.writing")
    try:
        yield aside
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
