# SPDX-License-Identifier: Apache-2.0
"""Pairs of photographs worth matching: one is among the ALIKE whose largest features look most like the other's (Wu,
Towards linear-time incremental structure from motion, 2013, a hundredth of the cost of matching all features), the
NEAREST by the positions in EXIF, or the FOLLOWING in a video or in a row of numbered names.
"""

import itertools
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

ALIKE, NEAREST, FOLLOWING = 10, 5, 5
LARGEST = 256
"""Largest number of features of a photograph that are compared; fewer from a thousand photographs on."""
SAME = 0.8
"""Descriptors with a cosine above this look the same."""
NUMBERED_SHARE = 0.9
"""Minimum share of neighbours by name with close numbers in a folder that is one walk."""
LARGEST_GAP = 3
"""Largest difference of close numbers: a blurred photograph or two may be missing."""
AT_ONCE = 32
"""Photographs compared with one at once: bounds the memory."""

Advance = Callable[[float], None]
"""Called with the number of finished pieces of work."""
Pairs = list[tuple[int, int]]
"""Sorted pairs of indices, first < second."""


def likely_pairs(alike: np.ndarray, positions: np.ndarray, in_a_row: bool) -> Pairs:
    """Pairs worth matching, by `shared_features` [N, N], positions [N, 3] in metres (NaN where unknown), and whether
    photographs follow each other along a path."""
    count = len(alike)
    chosen = np.zeros((count, count), dtype=bool)
    _choose_best(chosen, np.where(alike > 0, alike, -np.inf), ALIKE)
    _choose_best(chosen, -np.linalg.norm(positions[:, None] - positions[None], axis=-1), NEAREST)
    if in_a_row:
        for step in range(1, min(FOLLOWING, count - 1) + 1):
            chosen |= np.eye(count, k=step, dtype=bool)
    first, second = np.nonzero(np.triu(chosen | chosen.T, k=1))
    return list(zip(first.tolist(), second.tolist(), strict=True))


def _choose_best(chosen: np.ndarray, scores: np.ndarray, number: int) -> None:
    """Mark in each row of `chosen` the `number` other columns with the highest finite scores."""
    scores = np.where(np.isfinite(scores) & ~np.eye(len(scores), dtype=bool), scores, -np.inf)
    for row, order in enumerate(np.argsort(-scores, axis=1, kind="stable")[:, :number]):
        chosen[row, order[scores[row, order] > -np.inf]] = True


def shared_features(descriptors: list[np.ndarray], advance: Advance) -> np.ndarray:
    """Numbers of shared features (mutual best matches that look the same), int [N, N], symmetric, 0 on the diagonal, by
    each photograph's descriptors [n, 128], largest feature first."""
    count = len(descriptors)
    size = max(min(LARGEST, 1000 * LARGEST // count), LARGEST // 4)
    table = np.zeros((count, size, 128), dtype=np.float32)
    for row, each in zip(table, descriptors, strict=True):
        part = each[:size].astype(np.float32)
        row[: len(part)] = part / np.maximum(np.linalg.norm(part, axis=1, keepdims=True), 1e-6)
    shared = np.zeros((count, count), dtype=np.int64)
    for one in range(count):
        for start in range(one + 1, count, AT_ONCE):
            others = table[start : start + AT_ONCE]
            cosines = (table[one] @ others.reshape(-1, 128).T).reshape(size, len(others), size)
            there, back = cosines.argmax(axis=2), cosines.argmax(axis=0)  # [size, M] and [M, size]
            mutual = np.take_along_axis(back.T, there, axis=0) == np.arange(size)[:, None]
            shared[one, start : start + len(others)] = (mutual & (cosines.max(axis=2) > SAME)).sum(axis=0)
        advance(1)
    return shared + shared.T


def numbered_in_a_row(names: list[str]) -> bool:
    """Whether nine in ten neighbours by name have numbers that differ by at most three."""
    numbers = [re.findall(r"\d+", Path(name).stem) for name in names]
    steps = [int(b[-1]) - int(a[-1]) if a and b else 0 for a, b in itertools.pairwise(numbers)]
    return sum(1 <= step <= LARGEST_GAP for step in steps) >= NUMBERED_SHARE * len(steps) > 0


def metres(positions: np.ndarray) -> np.ndarray:
    """Latitudes and longitudes [N, 2] in degrees, NaN where unknown, as places on a sphere, in metres from its middle,
    [N, 3]."""
    latitude, longitude = np.radians(positions).T
    along = np.stack([np.cos(longitude), np.sin(longitude)], axis=1) * np.cos(latitude)[:, None]
    return 6_371_000.0 * np.column_stack([along, np.sin(latitude)])
