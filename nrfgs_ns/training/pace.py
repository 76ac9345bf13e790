# SPDX-License-Identifier: Apache-2.0
"""How fast a training walks through its schedules.

Learning rates, the rise of resolution and of harmonics, and the first and last step of densification are laid out for
a training of L steps. A training that makes another number of steps can walk through the same schedules at another
pace: after each step its *position* on them, 0 to L, moves on by the pace's *rate*, and what is scheduled is looked up
at the position. Without a pace the position is the step, and the rate is 1.

- `Pace`: the rate is what it is, L / N for N steps.
- `TimedPace`: the rate is chosen anew after each step such that position L and the end of a time budget meet,

      rate(p) = seconds per step / seconds left * integral_p^L c(u) / c(p) du

  where c(u) says what a step at position u costs, up to a factor. A wrong c or a machine that changes its speed
  makes for an uneven walk, not for another end: training stops when the time is up.

What counts rounds rather than progress stays as it is, in steps: the distance between two refinements and two resets of
opacity, which must see every view, and the averages of Adam.
"""

import math
from collections import deque
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

STEPS = 30_000
"""The training that the methods' schedules are laid out for."""
STEPS_PER_VIEW = 120
"""Steps for each training view, where their number is chosen; `bonsai`'s 255 views have as many in `STEPS`."""
FEWEST_STEPS = 10_000
"""Steps of a training of few views, where their number is chosen."""
STEPS_BEFORE_PLANNING = 10
"""Steps at rate 1 before a timed training plans: the first ones also compile and warm up."""
ROUNDING = 1e-6
"""In steps: positions are sums of rates."""
STEPS_IN_MEDIAN = 51
"""The pace of the machine is the median of this many steps: evaluations and checkpoints in between do not count as
steps."""


def steps_for(views: int) -> int:
    """How many steps suit a capture: few views are learnt by heart in many."""
    return min(max(STEPS_PER_VIEW * views, FEWEST_STEPS), STEPS)


class Pace:
    """A constant rate: positions for each step, positive."""

    def __init__(self, length: int, rate: float = 1.0):
        self.length = length
        self.rate = rate
        self.position = 0.0
        """0 at the first step; stays at L once it is there"""

    def start(self) -> None:
        """Training begins, or goes on, now."""

    def begin_step(self) -> None:
        """A step begins now."""

    def advance(self) -> None:
        """The position of the next step. Call it once in each step."""
        self.position = min(self.position + self.rate, float(self.length))

    def step_at(self, position: float, now: int) -> int:
        """The first step of this training that will have reached a position, as things look now; 0 if it lies behind.

        Args:
            now: the step whose position is `self.position`.
        """
        ahead = (position - self.position) / self.rate
        return now + math.ceil(ahead - ROUNDING) if ahead > -ROUNDING else 0

    def state(self) -> dict[str, Any]:
        """What a checkpoint must hold."""
        return {"length": self.length, "rate": self.rate, "position": self.position}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint's `state`."""
        self.length, self.rate, self.position = state["length"], state["rate"], state["position"]


class TimedPace(Pace):
    """A rate that lets the schedules end when the time does.

    Args:
        seconds: the budget, positive, from the start of training to the end of its last step: warm-up, evaluations
            and checkpoints in between and time in which the viewer pauses it are part of it.
        phases: pairs (position at which the phase ends, cost of a step in it), in order; the last one has no end
            (infinity). Costs are relative to each other.
        clock: seconds, for tests.
    """

    def __init__(
        self,
        length: int,
        seconds: float,
        phases: list[tuple[float, float]] | None = None,
        clock: Callable[[], float] = perf_counter,
    ):
        super().__init__(length)
        self.seconds = seconds
        self.phases = phases or [(math.inf, 1.0)]
        self.clock = clock
        self.earlier = 0.0
        """seconds that the training took before it went on from a checkpoint"""
        self._started: float | None = None
        self._begun: float | None = None
        self._durations: deque[float] = deque(maxlen=STEPS_IN_MEDIAN)

    @property
    def elapsed(self) -> float:
        """Seconds since training began, interruptions left out."""
        return self.earlier + (0.0 if self._started is None else self.clock() - self._started)

    @property
    def step_seconds(self) -> float:
        """What a step takes at present; 0 before the first has ended."""
        return median(self._durations) if self._durations else 0.0

    @property
    def is_spent(self) -> bool:
        """Whether the end of the budget is nearer now than after another step."""
        return self.elapsed + 0.5 * self.step_seconds >= self.seconds

    @property
    def steps_left(self) -> int:
        """How many steps fit in, as things look now."""
        return math.ceil((self.length - self.position) / self.rate)

    def start(self) -> None:
        self._started, self._begun = self.clock(), None

    def begin_step(self) -> None:
        now = self.clock()
        if self._begun is not None:
            self._durations.append(now - self._begun)
        self._begun = now

    def advance(self) -> None:
        if len(self._durations) >= STEPS_BEFORE_PLANNING:
            step = self.step_seconds
            # The schedules' last position is for the last step, not for one behind it.
            left = max(self.seconds - self.elapsed, step)
            self.rate = max(step / left * self._work_left(), 1e-9)
        super().advance()

    def _work_left(self) -> float:
        """Steps of the present cost that would do all that is left at rate 1."""
        total, begin, present = 0.0, self.position, None
        for end, cost in self.phases:
            end = min(end, float(self.length))
            if end > begin:
                present = present or cost
                total += (end - begin) * cost
                begin = end
        return total / present if present else 0.0

    def state(self) -> dict[str, Any]:
        # A budget that is spent but for half a step is spent.
        seconds = max(self.elapsed, self.seconds) if self.is_spent else self.elapsed
        return {**super().state(), "seconds": seconds}

    def load_state(self, state: dict[str, Any]) -> None:
        super().load_state(state)
        self.earlier = state.get("seconds", 0.0)


COST_OF_HALF_RESOLUTION = 0.5
"""Guess: a step at half the resolution costs half as much, between a quarter, as its pixels, and 1, as its splats. It
decides how evenly a timed training walks, not when it ends."""


def resolution_phases(num_downscales: int, resolution_schedule: int) -> list[tuple[float, float]]:
    """What steps cost while the resolution rises, for `TimedPace`.

    Args:
        num_downscales: how many times the resolution doubles.
    """
    rising = [
        (float((done + 1) * resolution_schedule), COST_OF_HALF_RESOLUTION ** (num_downscales - done))
        for done in range(num_downscales)
    ]
    return [*rising, (math.inf, 1.0)]
