# SPDX-License-Identifier: Apache-2.0
"""Exceptions meant for the user rather than for the programmer."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

DEBUG = os.environ.get("NRFGS_DEBUG", "0") not in ("", "0")
"""NRFGS_DEBUG=1: such exceptions show their traceback."""
LONGEST, LONGEST_REASON = 160, 500
"""Characters of a value in a message, and of what an exception says."""


class ForTheUser(Exception if DEBUG else SystemExit):
    """Ends a command with its message as the last line and status 1, without a traceback.

    It is a SystemExit because most commands are nerfstudio's: uncaught, it ends the program, and Python prints the
    message.
    """


class InputError(ForTheUser, ValueError):
    """A data set, file, checkpoint or option of the user cannot be used.

    The message has three parts: the file or field, what was found there, and what the user can do next. It is raised
    before time is spent on training.
    """


def shown(value: Any, longest: int = LONGEST) -> str:
    """A value from a file for a message: one printable line of bounded length."""
    text = value if isinstance(value, str) and value.isprintable() else ascii(value)
    return text if len(text) <= longest else f"{text[: longest // 2]}...{text[-longest // 2 :]}"


def require(holds: bool, option: str, value: Any, needed: str) -> None:
    """Raise InputError naming an option, its value and what is `needed`, unless the condition holds."""
    if not holds:
        raise InputError(f"{option} is {value}; it must be {needed}.")


@contextlib.contextmanager
def refusing(finding: str, fix: str, *kinds: type[Exception]) -> Iterator[None]:
    """Turn an exception of these kinds into InputError: the finding, what the exception says, and the fix. One that is
    meant for the user already passes."""
    try:
        yield
    except ForTheUser:
        raise
    except kinds as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(":.")
        raise InputError(f"{finding} ({shown(reason, LONGEST_REASON)}). {fix}") from error


def mind_the_reader() -> None:
    """From now on a command whose output nobody reads on (`| head`) ends without a traceback, with status 1."""
    show = sys.excepthook

    def show_if_read(kind, error, trace):
        try:
            if kind is BrokenPipeError:
                print(flush=True)  # fails if it was standard output
            show(kind, error, trace)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left to write

    sys.excepthook = show_if_read
