# SPDX-License-Identifier: Apache-2.0
"""Which training photograph's exposure and colour a rendering outside of training takes."""

import os

from nrfgs_ns.data.checks import warn
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.photograph import PhotographModel

LOOK = "NRFGS_LOOK"
"""Environment variable: a training photograph's file name; without it, renderings have the photographs' mean look."""


def look_asked_for(photograph: PhotographModel | None) -> int | None:
    """The index of the photograph that LOOK names; None, with a warning, if no exposures have been learnt.

    Raises:
        InputError: there is no such photograph.
    """
    name = os.environ.get(LOOK)
    if not name:
        return None
    if photograph is None:
        warn(f"{LOOK} is {name!r}, but this model has learnt no photograph's exposure: all renderings have one look.")
        return None
    if name not in photograph.names:
        raise InputError(f"{LOOK} is {name!r}, which is not a training photograph, such as {photograph.names[0]!r}.")
    return photograph.names.index(name)
