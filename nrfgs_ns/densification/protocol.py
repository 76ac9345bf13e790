# SPDX-License-Identifier: Apache-2.0
"""The interface of all protocols of densification, and which opacity they take a splat to have."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, MutableMapping
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from nrfgs_ns.appearance.diffuse import DIFFUSE, SHIFT

Protocol = Literal["splatfacto", "original", "mcmc"]
OpacitySeen = Literal["base", "peak"]

UNSEEN = -1.0
"""Peak opacity of a splat that no view has shown since then."""


class Densification(ABC):
    """What the model asks of a protocol. `state` is all that a continued training needs, and goes into checkpoints."""

    name: Protocol
    absgrad: bool = False
    """Whether the rasterizer must leave sum |dL/dmean2d| in `info["means2d"].absgrad`."""
    state: dict[str, Any]
    """Numbers, tensors with a row per splat, or None for what the first step has to make."""

    def __init__(self, opacity_seen: OpacitySeen):
        self.opacity_seen = opacity_seen
        self.state = {"peak": None} if opacity_seen == "peak" else {}

    def see_cameras(self, centers: Tensor) -> None:  # noqa: B027  (only some protocols measure by the cameras)
        """Tell the protocol where the training cameras are, [V, 3], before the first step."""

    def pre_backward(self, step: int, info: Mapping[str, Any], opacities: Tensor, count: int) -> None:
        """Look at a training view before the loss goes backward.

        Args:
            step: training step.
            info: the rasterizer's; M rows.
            opacities: what the head said, [M] in [0, 1], before antialiasing compensation.
            count: number of splats N.
        """
        if self.opacity_seen == "peak":
            if self.state["peak"] is None:
                self.state["peak"] = torch.full((count,), UNSEEN, device=opacities.device)
            shown = opacities.detach().to(self.state["peak"].dtype)
            self.state["peak"].scatter_reduce_(0, info["gaussian_ids"], shown, "amax")

    @abstractmethod
    def post_backward(
        self,
        step: int,
        info: Mapping[str, Any],
        splats: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
    ) -> None:
        """Change the table after the optimisers' step.

        Args:
            step: training step.
            info: the rasterizer's, as in `pre_backward`, with gradients.
            splats: the table; entries are replaced.
            optimizers: one for each entry, under its name, each with one parameter group; others are left alone.
        """

    def regularisation(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Terms that the protocol adds to the loss, by name."""
        return {}

    @abstractmethod
    def reschedule(self, step_at: Callable[[float], int]) -> None:
        """Begin and end when the training's pace says (`pace.py`); the steps between two refinements stay.

        Args:
            step_at: step of the configuration -> step of this training.
        """

    def load_state(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Continue from a checkpoint's `state`. A statistic that it does not hold starts anew."""
        for name in self.state:
            value = state.get(name, self.state[name])
            self.state[name] = value.to(device) if isinstance(value, Tensor) else value
        for name in (DIFFUSE, SHIFT):  # which protocol it is does not matter, nor whether such splats are looked for
            self.state.pop(name, None)
            if state.get(name) is not None:
                self.state[name] = state[name].to(device)

    def seen_opacity(self, opacities: Tensor) -> Tensor:
        """The opacities [N] that decide whether a splat is dead.

        "base": the stored ones. "peak": the largest that any view has shown since the last refinement or reset, and the
        stored one where no view has shown the splat.

        Args:
            opacities: logits [N, 1].
        """
        base = torch.sigmoid(opacities.detach().flatten())
        peak = self.state.get("peak")
        return base if peak is None else torch.where(peak > UNSEEN, peak, base)

    def forget_peak(self) -> None:
        """Start the running maximum anew."""
        if self.state.get("peak") is not None:
            self.state["peak"].fill_(UNSEEN)
