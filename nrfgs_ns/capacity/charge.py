# SPDX-License-Identifier: Apache-2.0
"""When residuals cost something: from the end of densification to the last decision.

A field that is kept from helping leaves larger gradients on the screen, and densification answers them with splats. So
nothing is charged while a step may still add some.
"""

import math

from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.errors import InputError
from nrfgs_ns.pace import TimedPace

OPTION = "pipeline.model.residual-cost"


class ResidualCharge:
    """Says in which steps of a training residuals are part of the loss.

    Args:
        model: an NrfgsModel with a positive residual_cost.
        deciders: who looks at the splats or the field, with `is_done(step)`: whether nothing is left to be decided
            after this step.
        trainer: the training's; None if there is none, and then no last step.
        start: first step of this training.
    """

    def __init__(self, model, deciders: list, trainer, start: int):
        self.model, self.deciders = model, deciders
        self.end = math.inf if trainer is None else start + trainer.config.max_num_iterations - 1

    def is_due(self, step: int) -> bool:
        """Whether residuals are charged in this step."""
        pace, last = self.model.pace, self.end
        if isinstance(pace, TimedPace):  # as things look now; the schedules are through behind the last step
            last = max(pace.step_at(pace.length, step) - 1, step)
        undecided = any(not decider.is_done(step - 1) for decider in self.deciders)
        return undecided and self.model.densification.has_ended(step, last)


def charge_for(model, deciders: list, trainer, start: int) -> ResidualCharge | None:
    """What a model's configuration asks for; None where residuals cost nothing, or nobody decides.

    Args:
        as for `ResidualCharge`.

    Raises:
        InputError: the cost is out of range.
    """
    cost = model.config.residual_cost
    if not 0.0 <= cost < math.inf:
        raise InputError(f"{OPTION} is {cost}; it must be zero or positive.")
    if cost == 0.0:
        return None
    if not deciders:
        _warn("nothing is decided in this training. Ask for capacity 'auto' or diffuse splats, or leave it out")
        return None
    charge = ResidualCharge(model, deciders, trainer, start)
    latest = min(max(decider.last_decision for decider in deciders), charge.end)
    if model.pace is None and not model.densification.has_ended(latest, charge.end):
        _warn(f"densification adds splats until after the last decision, in step {latest}. Decide later, or end it")
    return charge


def _warn(why: str) -> None:
    CONSOLE.print(f"[bold yellow]{OPTION} has no effect: {why}.", soft_wrap=True)
