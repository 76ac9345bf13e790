# SPDX-License-Identifier: Apache-2.0
"""Options of the search for the capacity that a scene needs."""

from dataclasses import dataclass
from typing import Literal

Capacity = Literal["full", "auto"]
"""Which parts of its field a model keeps: those of its configuration, or those that pay."""


@dataclass
class CapacitySearch:
    """When and how capacity "auto" finds out what a scene needs."""

    step: int = 20_000
    """step after which it is decided, once: late, because what is dropped does not come back, and gloss is learnt last;
    not right after opacities are reset. With stretched schedules, a step of the schedules"""
    views: int | None = None
    """training views, evenly spaced, that are set aside until then, to decide on. None: an eighth of all, at least 2
    and at most 16"""
    settle: int = 100
    """steps in which each field that is tried, the whole one included, gets used to what it is without, before it is
    measured for the first time. If a part is then worth more than may go, both fields go on for as many steps again,
    and so on as long as each time a quarter is taken off that"""
    settle_most: int = 1600
    """most steps of that, at least settle: where views are few, it takes long to see that a part is not needed"""
    tolerance_db: float = 0.05
    """dB that all that is dropped may cost on the views set aside. High branch, opacity's residual and distance may
    take half of it, the latents' rank what is left. Each of the three goes unless it is worth more than that half by
    more than the standard error over the views; latents are judged without one"""
