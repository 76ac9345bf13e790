# SPDX-License-Identifier: Apache-2.0
"""How fast a training walks through its schedules.

Learning rates, the rise of resolution and of harmonics, and the first and last step of densification are laid out for
a training of L steps. A training of another length can walk through the same schedules: each step advances its
*position* on them, 0 to L, by the pace's *rate*. Without a pace the position is the step, and the rate is 1.

- `Pace`: a constant rate, L / N for N steps.
- `TimedPace`: after each step the rate is chosen so that the training reaches position L when the time budget ends,

      rate(p) = seconds per step / seconds left * integral_p^L c(u) / c(p) du

  where c(u) is the relative cost of a step at position u: half as much at half the resolution, which has a quarter of
  the pixels and all splats. A wrong c makes the walk uneven but does not move its end: training stops when the time is
  up.

Adam's averages and the distances between refinements and between resets of opacity, which must see every view, stay
in steps.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from time import perf_counter
from typing import Any

from nrfgs_ns.errors import InputError

STEPS = 30_000
"""Length of the training that the methods' schedules are laid out for."""
STEPS_PER_VIEW = 120
"""Steps for each training view, where their number is chosen: those of `bonsai`'s 255 views in `STEPS`."""
FEWEST_STEPS = 10_000
"""Fewest steps, where their number is chosen."""
STEPS_BEFORE_PLANNING = 10
"""Steps at rate 1 before a timed training plans: the first ones also compile and warm up."""
ROUNDING = 1e-6
"""Error of positions, which are sums of rates, in steps."""
STEPS_IN_MEDIAN = 51
"""Steps in the median that estimates a step's duration, so that evaluations and checkpoints in between do not count."""


def steps_for(views: int) -> int:
    """Steps for a capture: with more, few views are learnt by heart."""
    return min(max(STEPS_PER_VIEW * views, FEWEST_STEPS), STEPS)


class Pace:
    """A constant, positive rate: positions per step."""

    def __init__(self, length: int, rate: float = 1.0):
        self.length = length
        self.rate = rate
        self.position = 0.0
        """0 at the first step, at most L"""

    def advance(self) -> None:
        """Move on to the next step's position."""
        self.position = min(self.position + self.rate, float(self.length))

    def step_at(self, position: float, now: int) -> int:
        """The first step, `now` or later, at or beyond a position at the present rate; 0 if the position is behind."""
        ahead = (position - self.position) / self.rate
        return now + math.ceil(ahead - ROUNDING) if ahead > -ROUNDING else 0

    def state(self) -> dict[str, Any]:
        """The position on the schedules, for a checkpoint."""
        return {"length": self.length, "rate": self.rate, "position": self.position}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint's `state`."""
        self.length, self.rate, self.position = state["length"], state["rate"], state["position"]

    def plan(self, steps: int) -> None:
        """Walk through the rest of the schedules in this number of steps."""
        rate = (self.length - self.position) / steps
        if not math.isclose(rate, self.rate, rel_tol=1e-9):  # an unchanged rate stays the same to the last bit
            self.rate = max(rate, 1e-9)


class TimedPace(Pace):
    """A rate that lets the schedules end when the time does.

    Args:
        seconds: the budget from the start of training to the end of its last step, including warm-up, evaluations,
            checkpoints and pauses.
        doublings: positions at which the resolution doubles, ascending.
        clock: seconds, for tests.
    """

    def __init__(self, length: int, seconds: float, doublings: Sequence[int] = (), clock=perf_counter):
        super().__init__(length)
        self.seconds = seconds
        self.doublings = doublings
        self.clock = clock
        self.earlier_seconds = 0.0
        """seconds before the checkpoint that the training goes on from"""
        self._training_began: float | None = None
        self._advanced = 0.0
        self._durations: deque[float] = deque(maxlen=STEPS_IN_MEDIAN)

    @property
    def elapsed(self) -> float:
        """Seconds of training, without interruptions."""
        return self.earlier_seconds + (0.0 if self._training_began is None else self.clock() - self._training_began)

    @property
    def step_seconds(self) -> float:
        """Median duration of the latest steps; 0 before the first has ended."""
        return median(self._durations) if self._durations else 0.0

    @property
    def is_spent(self) -> bool:
        """Whether the budget ends nearer to now than to the end of another step."""
        return self.elapsed + 0.5 * self.step_seconds >= self.seconds

    @property
    def steps_left(self) -> int:
        """Estimated number of steps to come; beyond the schedules' end, as with a larger budget, by the clock."""
        if self.position >= self.length and self.step_seconds > 0:
            return math.ceil(max(self.seconds - self.elapsed, 0.0) / self.step_seconds - 0.5)
        return math.ceil((self.length - self.position) / self.rate)

    def start(self) -> None:
        """Training begins, or goes on, now."""
        self._training_began = self._advanced = self.clock()

    def advance(self) -> None:
        now = self.clock()
        self._durations.append(now - self._advanced)
        self._advanced = now
        if len(self._durations) >= STEPS_BEFORE_PLANNING:
            step = self.step_seconds
            # The schedules' last position is for the last step, not for one behind it.
            seconds_left = max(self.seconds - self.elapsed, step)
            self.rate = max(step / seconds_left * self._cost_ahead(), 1e-9)
        super().advance()

    def _cost_ahead(self) -> float:
        """The integral in the module's docstring: the cost of the way to L at rate 1, in steps of the present cost."""
        ahead = [position for position in self.doublings if self.position < position < self.length]
        ends = pairwise([self.position, *ahead, self.length])
        return sum((end - begin) * 2.0**doubled for doubled, (begin, end) in enumerate(ends))

    def state(self) -> dict[str, Any]:
        # A budget that is spent but for half a step is spent.
        seconds = max(self.elapsed, self.seconds) if self.is_spent else self.elapsed
        return {**super().state(), "seconds": seconds}

    def load_state(self, state: dict[str, Any]) -> None:
        super().load_state(state)
        self.earlier_seconds = state.get("seconds", 0.0)

    def plan(self, steps: int) -> None:
        """Refuse a budget that is spent; the clock says how many steps there are."""
        if self.is_spent:
            budget = f"its time budget of {self.seconds / 60:g} minutes"
            raise InputError(f"The training has used {budget}. A larger --time-budget goes on.")


def resume(pace: Pace | None, saved: dict[str, Any] | None, step: int, steps: int, devices: int) -> None:
    """Go on from a checkpoint's position on the schedules; InputError where they do not go on.

    Args:
        saved: `Pace.state` in the checkpoint; None: its schedules were not stretched.
        step: the first step to come.
        steps: number of steps to come; with a time budget it does not count.
        devices: their number.
    """
    if saved is not None and (pace is None or type(pace) is Pace and pace.length != saved["length"]):
        option = "a --time-budget" if "seconds" in saved else f"--schedule-steps {saved['length']}"
        fix = f"Go on with {option}" if devices == 1 else "Go on with one device"
        raise InputError(f"The schedules of the checkpoint's training are stretched. {fix}, or train anew.")
    if pace is None:
        return
    if saved is not None:
        pace.load_state(saved)
    elif pace.length < step:
        raise InputError(f"Schedules of {pace.length} steps end before step {step}. Give more --schedule-steps.")
    else:
        pace.position = float(step)
    pace.plan(steps)
