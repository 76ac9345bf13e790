# SPDX-License-Identifier: Apache-2.0
"""Some views of many: evenly spaced ones, and training views that are held out of the training."""

from nrfgs_ns.errors import InputError


def evenly_spaced(total: int, wanted: int) -> list[int]:
    """At most `wanted` of 0..total-1, evenly spaced, the first among them."""
    count = min(total, wanted)
    return [i * total // count for i in range(count)]


def held_out(total: int, wanted: int | None = None) -> list[int]:
    """Training views to hold out, evenly spaced, none at either end.

    Args:
        total: number of training views.
        wanted: how many; None: an eighth of all, at least 2 and at most 16.

    Raises:
        InputError: that would be all of them.
    """
    number = min(max(total // 8, 2), 16) if wanted is None else wanted
    if number >= total:
        raise InputError(f"{number} of {total} training views cannot be held out: none would be left. Hold out fewer.")
    return [(2 * i + 1) * total // (2 * number) for i in range(number)]
