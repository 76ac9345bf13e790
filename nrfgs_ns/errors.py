# SPDX-License-Identifier: Apache-2.0
"""The one exception that is meant for the user rather than for the programmer."""


class InputError(ValueError):
    """Something the user handed over (a data set, a file, a checkpoint, an option) cannot be used.

    The message has three parts: the file or field it is about, what was found there, and the mend, that is what
    the user can do next. It is raised before time is spent on training.
    """
