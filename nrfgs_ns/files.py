# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there."""

import contextlib
import os
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

from nrfgs_ns.errors import InputError


def check_writable(path: Path, option: str) -> None:
    """Make the folders that a file will lie in, and raise InputError where it cannot be written: a command asks before
    its work, not after it.

    Args:
        option: that named the file, for the message.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise InputError(f"{option} {path} is a folder. Name a file in it.")
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f"{path.name}.", suffix=".writing"):
            pass
    except OSError as error:
        raise InputError(f"{option} {path} cannot be written ({error}). Name a file in a folder of yours.") from error


def write_whole(path: Path, text: str) -> None:
    """Write a file aside and move it into place: a reader finds all of it or none."""
    with whole(path) as aside:
        aside.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file to write in place of `path`, which becomes it when the block ends, and vanishes if the block fails.

    Each writer has a file of its own: of several processes that write the same one at once, the last one's stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.writing")
    try:
        yield aside
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
