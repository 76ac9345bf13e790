# SPDX-License-Identifier: Apache-2.0
"""Training views that no step trains on until all that is decided by them is decided."""

from typing import Protocol

from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.errors import InputError

LARGEST_USUAL_SHARE = 0.25
"""Of the training views: that more are set aside is worth a warning."""


class Decider(Protocol):
    """Who decides by views that are not trained on."""

    option: str
    """what asks for it, for messages"""
    last_decision: int
    """the step after which it decides for the last time"""
    stretched: bool
    """whether that is a step of the schedules, which are stretched; else it is one of the training"""

    def views_wanted(self) -> int | None:
        """How many views; None: an eighth of the training's, at least 2 and at most 16."""

    def is_done(self, step: int) -> bool:
        """Whether nothing is left to be decided after this step."""


class ViewsAside:
    """Keeps views back as long as one of some deciders needs them.

    Args:
        data: the datamanager.
        deciders: none of them: nothing happens.
        start: first step of this training; more than 0 where it goes on from a checkpoint.

    Raises:
        InputError: there are too few views, or the checkpoint's training has trained on all of them.
    """

    def __init__(self, data, deciders: list[Decider], start: int):
        self.data, self.deciders = data, deciders
        waiting = [decider for decider in deciders if not decider.is_done(start - 1)]
        if not waiting:
            data.give_back_views()
        elif not data.views_aside:
            if start > 0:
                raise InputError(
                    f"{waiting[0].option} decides by views that the training has not seen, but that of the checkpoint "
                    f"has trained on all views for {start} steps. Leave it out, or train anew."
                )
            count = len(data.train_dataset)
            data.set_views_aside(spread(count, waiting))
            _tell(len(data.views_aside), count, waiting)

    def after_step(self, step: int) -> None:
        """Give the views back when all is decided."""
        if self.data.views_aside and all(decider.is_done(step) for decider in self.deciders):
            self.data.give_back_views()


def _tell(number: int, count: int, waiting: list[Decider]) -> None:
    latest: dict[bool, int] = {}
    for decider in waiting:
        latest[decider.stretched] = max(decider.last_decision, latest.get(decider.stretched, 0))
    until = " and ".join(f"step {step}{' of the schedules' if stretched else ''}" for stretched, step in latest.items())
    much = number > LARGEST_USUAL_SHARE * count
    CONSOLE.print(
        f"{'[bold yellow]' if much else ''}{number} of {count} training views are set aside until {until}, to "
        f"decide by them{': that is much, and the others may not be enough to learn from' if much else ''}.",
        soft_wrap=True,
    )


def spread(count: int, deciders: list[Decider]) -> list[int]:
    """Evenly spaced views, as many as the decider wants that wants most.

    Args:
        count: number of training views.

    Raises:
        InputError: it wants them all.
    """
    wanted = [decider.views_wanted() for decider in deciders]
    number = max(min(max(count // 8, 2), 16) if views is None else views for views in wanted)
    if number >= count:
        raise InputError(
            f"{deciders[0].option} sets {number} training views aside, of {count}. Set fewer aside, or leave it out."
        )
    return [(2 * i + 1) * count // (2 * number) for i in range(number)]
