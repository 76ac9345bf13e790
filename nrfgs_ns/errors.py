# SPDX-License-Identifier: Apache-2.0
"""Exceptions meant for the user rather than for the programmer."""

import os

DEBUG = os.environ.get("NRFGS_DEBUG", "0") not in ("", "0")
"""NRFGS_DEBUG=1: such exceptions show their traceback, and ns-train its whole configuration."""


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
