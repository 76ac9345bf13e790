# SPDX-License-Identifier: Apache-2.0
"""When residuals cost something: while one of several decides, and what densification is asked."""

import math
from types import SimpleNamespace

import pytest

from nrfgs_ns.capacity.charge import ResidualCharge
from nrfgs_ns.pace import Pace, TimedPace


def is_done(step: int) -> bool:
    return True


def is_waiting(step: int) -> bool:
    return False


def asked_for(pace, step: int, start: int = 0, steps: int | None = 30) -> tuple[int, float]:
    """The steps that densification is asked for in a training of so many steps; None: without a trainer."""
    asked = []
    densification = SimpleNamespace(has_ended=lambda *steps: asked.append(steps) or True)
    trainer = None if steps is None else SimpleNamespace(config=SimpleNamespace(max_num_iterations=steps))
    model = SimpleNamespace(pace=pace, densification=densification)
    assert ResidualCharge(
        model, [SimpleNamespace(is_done=is_done), SimpleNamespace(is_done=is_waiting)], trainer, start
    ).is_due(step)
    return asked[0]


@pytest.mark.parametrize("pace", [None, Pace(90, rate=3.0)])
def test_the_last_step_is_the_trainings(pace):
    """Stretched schedules are through at step 30, behind it: no splat is added there."""
    assert asked_for(pace, 4) == (4, 29)
    assert asked_for(pace, 14, start=10) == (14, 39)
    assert asked_for(pace, 4, steps=None) == (4, math.inf)


def test_with_a_time_budget_the_last_step_is_foreseen():
    """30 of 90 positions are behind, at 2 a step: 30 steps are left, of which this is the first."""
    pace = TimedPace(90, seconds=1.0)
    pace.position, pace.rate = 30.0, 2.0
    assert asked_for(pace, 100, steps=1000) == (100, 129)
    pace.position = 90.0  # the schedules are through, and time is left
    assert asked_for(pace, 200, steps=1000) == (200, 200)


def test_nothing_costs_when_all_is_decided():
    model = SimpleNamespace(pace=None, densification=SimpleNamespace(has_ended=lambda *steps: True))
    assert not ResidualCharge(model, [SimpleNamespace(is_done=is_done)] * 2, None, 0).is_due(4)
