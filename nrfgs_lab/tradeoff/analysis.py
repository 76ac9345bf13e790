# SPDX-License-Identifier: Apache-2.0
"""What a setting changes against the default, which of it is noise, and which settings nothing beats.

**Noise.** Two or three seeds say little about the spread of one setting, so the spread is pooled over all settings of a
scene: s^2 = sum (n_i - 1) s_i^2 / sum (n_i - 1). A difference of means over n and m seeds is told from noise if it
exceeds

    t s sqrt(1 / n + 1 / m),    t = the 97.5 % quantile of Student's t with sum (n_i - 1) degrees of freedom.

Where nothing changed, one comparison in twenty is still called a difference. Costs (time, frames, bytes) are compared
as ratios: all of this is done with their logarithms. Without a second seed anywhere nothing can be told from noise,
and everything is marked as such.

**Price.** What a setting buys is dB of PSNR for each doubling of a cost, (PSNR - PSNR_0) / log2(cost / cost_0). That
has a meaning only for a trade, where both go up or both go down; the rest is better, worse, or within the noise.
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from nrfgs_lab.bench.table import COLUMNS, Column, Row

LEVEL = 0.975
BY_NAME = {column.name: column for column in COLUMNS}
PSNR = BY_NAME["PSNR"]


@dataclass(frozen=True)
class Cost:
    """A cost of the trade: less is better."""

    column: Column
    title: str
    """what figure and table call it"""
    power: int = 1
    """the cost is the column's value to this power: -1 where more is better"""


COSTS = (
    Cost(BY_NAME["time s"], "training time"),
    Cost(BY_NAME["FPS"], "time for a frame", -1),
    Cost(BY_NAME["MB"], "bytes"),
)


@dataclass(frozen=True)
class Change:
    """The change of one quantity against the default."""

    value: float
    """difference, or ratio where `is_ratio`"""
    noise: float
    """a difference up to this, or a ratio within [1 / noise, noise], is noise; infinite if the spread is unknown"""
    is_ratio: bool = False

    @property
    def is_noise(self) -> bool:
        if self.is_ratio:
            return abs(math.log(self.value)) <= math.log(self.noise)
        return abs(self.value) <= self.noise


def pooled_deviation(samples: Sequence[Sequence[float]]) -> tuple[float | None, int]:
    """Deviation that all samples share, and its degrees of freedom.

    Returns:
        None and 0 if no sample has two values.
    """
    freedom = sum(len(sample) - 1 for sample in samples if len(sample) > 1)
    if freedom == 0:
        return None, 0
    squares = sum((len(sample) - 1) * statistics.variance(sample) for sample in samples if len(sample) > 1)
    return math.sqrt(squares / freedom), freedom


def noise_bound(deviation: float | None, freedom: int, n: int, m: int) -> float:
    """The largest difference of means over n and m values that is called noise."""
    if deviation is None:
        return math.inf
    from scipy.stats import t

    return float(t.ppf(LEVEL, freedom)) * deviation * math.sqrt(1.0 / n + 1.0 / m)


def changes(rows: Sequence[Row], default: Row, column: Column, ratio: bool) -> dict[str, Change]:
    """Each row's change of one column against the default's, by name of the run.

    Args:
        rows: those of one scene, the default among them.
        default: the row to compare with.
        column: what is compared. Rows without a value, and a default without one, give no change.
        ratio: compare as ratios, of those values that are positive.
    """
    samples = {row.run: list(row.values[column.name].values()) for row in rows}
    if ratio:  # a training that lost its last splat has no ratio
        samples = {run: [math.log(value) for value in values if value > 0] for run, values in samples.items()}
    deviation, freedom = pooled_deviation(list(samples.values()))
    base, result = samples[default.run], {}
    for name, sample in samples.items():
        if not sample or not base:
            continue
        difference = statistics.fmean(sample) - statistics.fmean(base)
        bound = noise_bound(deviation, freedom, len(sample), len(base))
        result[name] = Change(math.exp(difference), math.exp(bound), True) if ratio else Change(difference, bound)
    return result


def price(gain: Change, cost: Change, power: int = 1) -> tuple[str, float | None]:
    """What a setting buys for its cost.

    Args:
        gain: change of PSNR, dB.
        cost: change of the cost's column, a ratio.
        power: the cost is the column to this power.

    Returns:
        "same" (both within the noise), "noise" (PSNR within it, the cost not), "gain" and "loss" (the cost within it,
        PSNR not), "better" and "worse" (both changed, for the better or the worse), or "trade" with dB for each
        doubling of the cost.
    """
    if gain.is_noise:
        return ("same" if cost.is_noise else "noise"), None
    if cost.is_noise:
        return ("gain" if gain.value > 0 else "loss"), None
    doublings = power * math.log2(cost.value)
    if (gain.value > 0) == (doublings > 0):
        return "trade", gain.value / doublings
    return ("better" if gain.value > 0 else "worse"), None


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Numbers of the points (cost, quality) that no other beats, by rising cost.

    A point is beaten by one that costs no more and is worth no less, and differs in one of the two. Of equal points
    none beats the other.
    """
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1]))
    front: list[int] = []
    for i in order:
        if not front or points[i][1] > points[front[-1]][1] or points[i] == points[front[-1]]:
            front.append(i)
    return front


def front_of(rows: Sequence[Row], cost: Cost) -> list[str]:
    """Names of the runs on the front of PSNR against a cost, by rising cost."""
    points = {}
    for row in rows:
        quality, price_paid = row.mean(PSNR), row.mean(cost.column)
        if quality is not None and price_paid is not None:
            points[row.run] = (price_paid**cost.power, quality)
    names = list(points)
    return [names[i] for i in pareto_front(list(points.values()))]
