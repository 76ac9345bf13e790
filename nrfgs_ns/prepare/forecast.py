# SPDX-License-Identifier: Apache-2.0
"""How long the rest will take, from how long the features took on this machine as it is now.

Costs are in units of finding the features of a million pixels. They were taken from `castle` and `caliterra`
(results/prepare.json). What else the machine begins or ends with later is not in the forecast.
"""

import numpy as np

from nrfgs_ns.prepare.pairs import Pairs

MATCH = 4.6e-9
"""For each feature of one photograph of a pair and each of the other."""
MAP = 0.6
"""For each photograph."""
WRITE = 0.12
"""For each million pixels."""

Sizes = list[tuple[int, int]]
"""Width and height of photographs, pixels."""


def looked_at(sizes: Sizes, longest_side: int) -> float:
    """Millions of pixels in which features are found, where photographs are shrunk to a longest side."""
    shrunk = [min(1.0, longest_side / max(size)) for size in sizes]
    return sum(width * height * by**2 for (width, height), by in zip(sizes, shrunk, strict=True)) / 1e6


def still_to_do(sizes: Sizes, features: list[int], pairs: Pairs) -> float:
    """The cost of all that comes after the choice of pairs."""
    first, second = np.array(pairs, dtype=int).reshape(-1, 2).T
    counts = np.array(features, dtype=float)
    pixels = sum(width * height for width, height in sizes) / 1e6
    return float(MATCH * (counts[first] * counts[second]).sum() + MAP * len(sizes) + WRITE * pixels)


def in_words(seconds: float) -> str:
    """\"about 4 minutes\"."""
    if seconds < 50:
        return "less than a minute"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"about {minutes} minute{'s' if minutes > 1 else ''}"
    return f"about {minutes / 60:.1f} hours"
