# SPDX-License-Identifier: Apache-2.0
"""The mean of a model's parameters over a training's last steps (Polyak and Juditsky, SIAM Journal on Control and
Optimization 30, 1992).

Most learning rates never fall, and each step sees one view: parameters fluctuate around what they have learnt. Their
mean lies closer to the centre than the last step does.

Averaging is meaningless once a row denotes another splat. The mean therefore restarts where splats were added, removed,
moved onto others or had their opacity reset: these replace the `Parameter` objects, or the strategy says that it
overwrote rows in place (`moved_at`). MCMC's noise, which changes the means in place, is averaged away.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from nrfgs_ns.training.optimizers import parameters_of

LARGEST_SHARE = 0.02
"""Largest share of a training's steps to average, 200 of 10,000. Within a longer window a short training still
improves, so that the mean is worse than the last step."""


def window(average_steps: int, total: int) -> int:
    """Number of last steps to average in a training of `total` steps, at least 1."""
    return max(min(average_steps, int(LARGEST_SHARE * total)), 1)


class ParameterMean:
    """A running mean, m += (p - m) / n, of all parameters that a training's optimisers hold; `count` is n, or 0."""

    def __init__(self):
        self.forget()

    def forget(self) -> None:
        """Drop the mean."""
        self.count = 0
        self._means: dict[str, Tensor] = {}
        self._parameters: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, optimizers: Mapping[str, Optimizer]) -> None:
        """Add the present parameters to the mean."""
        if not self.is_current(optimizers):
            self._parameters = _parameters(optimizers)
            self._means = {name: torch.zeros_like(parameter) for name, parameter in self._parameters.items()}
            self.count = 0
        self.count += 1
        torch._foreach_lerp_(list(self._means.values()), list(self._parameters.values()), 1.0 / self.count)

    @torch.no_grad()
    def install(self) -> None:
        """Set the averaged parameters to their mean, if there is one; then forget it."""
        for name, parameter in self._parameters.items():
            parameter.copy_(self._means[name])
        self.forget()

    def state(self) -> dict[str, Any]:
        """`count` and means, for a checkpoint."""
        return {"count": self.count, "means": dict(self._means)}

    def load_state(self, state: Mapping[str, Any], optimizers: Mapping[str, Optimizer]) -> None:
        """Go on from the `state` of a checkpoint whose parameters have been loaded; other shapes are ignored."""
        parameters = _parameters(optimizers)
        shapes = {name: parameter.shape for name, parameter in parameters.items()}
        if {name: mean.shape for name, mean in state["means"].items()} != shapes:
            return  # the guard has removed splats since the mean was taken
        self.count = state["count"]
        self._means = {name: mean.to(parameters[name]) for name, mean in state["means"].items()}
        self._parameters = parameters

    def is_current(self, optimizers: Mapping[str, Optimizer]) -> bool:
        """Whether rows still denote the splats that were averaged: the parameters are these very objects."""
        parameters = _parameters(optimizers)
        return all(self._parameters.get(name) is parameter for name, parameter in parameters.items())


def _parameters(optimizers: Mapping[str, Optimizer]) -> dict[str, Tensor]:
    """All parameters, by group and index."""
    return {
        f"{group}.{place}": parameter
        for group, optimizer in optimizers.items()
        for place, parameter in enumerate(parameters_of(optimizer))
    }
