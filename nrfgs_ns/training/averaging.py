# SPDX-License-Identifier: Apache-2.0
"""The mean of a model's parameters over a training's last steps (Polyak and Juditsky, SIAM Journal on Control and
Optimization 30, 1992).

Most learning rates never fall, and each step sees one view: parameters walk about what they have learnt, and the last
step's are one place on that walk. Their mean lies nearer to its middle.

A mean over two meanings of a row is no number. It begins anew where splats were added, removed, moved onto others or
had their opacity reset, and where the field is another one: all put other `Parameter` objects in the place of the old
ones, even where shapes stay. The noise of MCMC, which changes the means in place at every step, is averaged away with
the rest.
"""

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.optim import Optimizer

from nrfgs_ns.data.checks import warn
from nrfgs_ns.training.optimizers import parameters_of


class ParameterMean:
    """A running mean, m += (p - m) / n, of all parameters that a training's optimisers hold.

    Attributes:
        count: n, steps that are in the mean; 0 where there is none.
        began_anew: whether there was one that had to be given up, because rows have come to mean something else.
    """

    def __init__(self):
        self.forget()

    def forget(self) -> None:
        """Let there be no mean."""
        self.count, self.began_anew = 0, False
        self._means: dict[str, Tensor] = {}
        self._of: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, optimizers: Mapping[str, Optimizer]) -> None:
        """Take the parameters as they are now into the mean."""
        parameters = _parameters(optimizers)
        if not self._is_of(parameters):
            self.began_anew = self.began_anew or self.count > 0
            self._means = {name: torch.zeros_like(parameter) for name, parameter in parameters.items()}
            self._of, self.count = parameters, 0
        self.count += 1
        torch._foreach_lerp_(list(self._means.values()), list(parameters.values()), 1.0 / self.count)

    @torch.no_grad()
    def install(self) -> None:
        """Let the parameters that it is of be the mean, if there is one; then forget it."""
        for name, parameter in self._of.items():
            parameter.copy_(self._means[name])
        self.forget()

    def state(self) -> dict[str, Any]:
        """What a checkpoint must hold: numbers and tensors."""
        return {"count": self.count, "began_anew": self.began_anew, "means": dict(self._means)}

    def load_state(self, state: Mapping[str, Any], model, optimizers: Mapping[str, Optimizer]) -> None:
        """Go on from a checkpoint's `state`, whose parameters have been loaded. A mean of others is left."""
        parameters = _parameters(optimizers)
        shapes = {name: parameter.shape for name, parameter in parameters.items()}
        if {name: mean.shape for name, mean in state["means"].items()} != shapes:
            return  # of splats that the guard has taken out since
        self.count, self.began_anew = state["count"], state["began_anew"]
        self._means = {name: mean.to(parameters[name]) for name, mean in state["means"].items()}
        self._of = parameters

    def is_current(self, optimizers: Mapping[str, Optimizer]) -> bool:
        """Whether rows mean what they meant when it was last added to."""
        return self._is_of(_parameters(optimizers))

    def _is_of(self, parameters: Mapping[str, Tensor]) -> bool:
        """Whether these very objects are those that it is the mean of."""
        same = self._of.keys() == parameters.keys()
        return same and all(parameter is self._of[name] for name, parameter in parameters.items())


def tell(count: int, window: int, began_anew: bool) -> None:
    """Say what a trained model is the mean of.

    Args:
        began_anew: whether it is so few because splats or the field have changed.
    """
    steps = "the last step" if count == 1 else f"the last {count} steps"
    why = f", not {window}: before that, splats or the field still changed" if began_anew else ""
    CONSOLE.print(f"The trained model is the mean of its parameters over {steps}{why}.", soft_wrap=True)


def tell_why_not(window: int, why: str) -> None:
    """Say that a trained model is the last step's, though a mean was asked for."""
    warn(f"average_steps is {window}, but nothing was averaged: {why}. The model is the last step's.")


def _parameters(optimizers: Mapping[str, Optimizer]) -> dict[str, Tensor]:
    """All parameters, by their group and their place in it."""
    return {
        f"{group}.{place}": parameter
        for group, optimizer in optimizers.items()
        for place, parameter in enumerate(parameters_of(optimizer))
    }
