# SPDX-License-Identifier: Apache-2.0
"""Which pairs of photographs are matched: those that may show the same thing.

All pairs of 75 photographs are 2,775, and most show nothing in common. A pair is likely if one of the two is among the

    ALIKE       whose largest features look most like the other's
    NEAREST     next to it, by the positions in EXIF
    FOLLOWING   that follow it, where photographs are frames of a video or numbered in a row

The largest features of a photograph are few and are found again from far away: matched with each other alone they tell
how much two photographs share (Wu, Towards linear-time incremental structure from motion, 2013), for a hundredth of the
cost of matching all. No vocabulary is needed.
"""

import itertools
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

ALIKE = 10
NEAREST = 5
FOLLOWING = 5
LARGEST = 256
"""Features of a photograph that are compared, at most; fewer where there are more than a thousand photographs."""
SAME = 0.8
"""Descriptors with a cosine above this look the same."""
NUMBERED_SHARE = 0.9
"""Share of neighbours by name whose numbers must follow each other closely for a folder to look like one walk."""
LARGEST_GAP = 3
"""Numbers that differ by no more follow each other closely: a blurred photograph or two may have been thrown away."""
AT_ONCE = 32
"""Photographs that one is compared with together: bounds the memory."""

Pairs = list[tuple[int, int]]
"""Of indices, each once, first < second, sorted."""


def every_pair(count: int) -> Pairs:
    return list(itertools.combinations(range(count), 2))


def likely_pairs(alike: np.ndarray, positions: np.ndarray | None, in_a_row: bool) -> Pairs:
    """The pairs that are worth matching.

    Args:
        alike: [N, N], how many features each two share; see `shared_features`.
        positions: [N, 2] in metres, NaN where unknown; None without any.
        in_a_row: photographs follow each other along a path.
    """
    count = len(alike)
    chosen = np.zeros((count, count), dtype=bool)
    _choose_best(chosen, np.where(alike > 0, alike, -np.inf), ALIKE)
    if positions is not None:
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


def shared_features(descriptors: list[np.ndarray], advance: Callable[[int], None]) -> np.ndarray:
    """How many of their largest features each two photographs share: [N, N], symmetric, 0 on the diagonal.

    Two features are shared if each is the other's best match and they look the same.

    Args:
        descriptors: for each photograph [n, 128], largest feature first.
        advance: called with 1 for each photograph.
    """
    count = len(descriptors)
    most = max(min(LARGEST, 1000 * LARGEST // count), LARGEST // 4)
    size = max(min(most, max((len(each) for each in descriptors), default=0)), 1)
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


def metres(positions: list[tuple[float, float] | None]) -> np.ndarray | None:
    """Latitudes and longitudes in degrees as [N, 2] metres east and north of their mean; None where fewer than two
    are known."""
    known = np.array([each if each is not None else (np.nan, np.nan) for each in positions], dtype=float).reshape(-1, 2)
    if np.isfinite(known[:, 0]).sum() < 2:
        return None
    degrees = known - np.nanmean(known, axis=0)
    metre = np.radians(1.0) * 6_371_000.0
    return np.stack([degrees[:, 1] * np.cos(np.radians(np.nanmean(known[:, 0]))), degrees[:, 0]], axis=1) * metre
