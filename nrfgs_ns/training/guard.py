# SPDX-License-Identifier: Apache-2.0
"""The guard: the first number of a training that is not finite stops it, with the last good state on disk.

Between the backward pass and the optimisers, the guard takes the largest absolute value of the rendered image, of each
loss and of each gradient, all in one fused call. NaN, infinity, or a gradient beyond `MAX_GRADIENT` (which Adam cannot
square) condemns the step. What happens then:

- On a CPU, the numbers are at hand: the training stops before the optimisers step.
- On a GPU, reading them would make the host wait in every step. Instead the verdict stays on the device, where fused
  Adam reads it (`found_inf`) and leaves parameters and moments as they are. A copy travels to the host meanwhile and is
  read at the head of the next step, whose projection would wait for the same work anyway. An optimiser that cannot read
  the verdict on the device is treated as on a CPU, waiting included.

Either way the parameters and moments that are left are those from before the condemned step, and the trainer writes
them as that step's checkpoint: training continued from it has skipped the step. On a GPU, densification may have run in
between; gradients that are not finite enter its statistics as zero.

Parameters are looked at before each checkpoint and every `PARAMETERS_EVERY` steps. Splats that are not finite (the
rasterizer does not draw them, so no gradient betrays them) are taken out before the checkpoint is written.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nrfgs_ns.densification.rows import take_rows
from nrfgs_ns.training.guard_report import Finding, report
from nrfgs_ns.training.in_sight import PATIENCE, InSight
from nrfgs_ns.training.optimizers import LeanOptimizers, parameters_of

MAX_GRADIENT = 2.0**63
"""Largest gradient that is let through. Its square, 2^126, and Adam's mean of squares stay below float32's 2^128; from
there on the second moment would be infinite and the parameter would never move again, in silence."""
PARAMETERS_EVERY = 100
"""Steps between two looks at the parameters."""


class TrainingStopped(RuntimeError):
    """A training met a number that is not finite.

    Args:
        message: what was met, where, and the likely cause.
        step: the condemned step.
        savable: whether the state that is left is good.
    """

    def __init__(self, message: str, step: int, savable: bool = True):
        super().__init__(message)
        self.step = step
        self.savable = savable


@dataclass
class _Verdict:
    """A step that has been looked at, and whose numbers are on their way to the host."""

    step: int
    names: list[str]
    """what was looked at; of gradients, the name of their optimiser"""
    tensors: list[Tensor]
    sizes: Tensor
    """largest absolute values, in host memory once `arrived` has happened"""
    arrived: torch.cuda.Event | None


class Guard:
    """Watches one training.

    Args:
        pipeline: nerfstudio's pipeline around an NrfgsModel.
    """

    def __init__(self, pipeline):
        self.pipeline = pipeline
        self.step = 0
        self.in_sight = InSight()
        self._verdict: _Verdict | None = None
        # Pinned memory and events are dear to make; one of each will do, for a verdict is read before the next is made.
        self._in_host_memory: Tensor | None = None
        self._arrival: torch.cuda.Event | None = None

    @property
    def model(self):
        return self.pipeline.model

    def begin(self, step: int, optimizers: LeanOptimizers) -> None:
        """Head of a training step: learn about the step before, and now and then look at the parameters.

        Raises:
            TrainingStopped: the step before was condemned, a parameter is not finite, or nothing is visible any more.
        """
        self.settle()
        self.step = step
        if self._out_of_sight():
            raise TrainingStopped(
                f"No splat has been visible in the last {PATIENCE} steps, so nothing is learnt. Poses and points are "
                "not of one world, or a learning rate has thrown the splats out of sight. The viewer shows where the "
                "cameras are.",
                step,
            )
        if step % PARAMETERS_EVERY == 0:
            self.check_parameters(optimizers)

    def before_optimizers(self, optimizers: LeanOptimizers, gradients_are_scaled: bool) -> None:
        """Look at image, losses and gradients, and condemn the step if one is not finite.

        Args:
            optimizers: those about to step.
            gradients_are_scaled: a GradScaler is at work, which meets infinite gradients as a matter of course and
                skips such steps itself: only the image and the losses are looked at.

        Raises:
            TrainingStopped: on a CPU, if the step is condemned.
        """
        watched = list(self.model.watched.items())
        if not gradients_are_scaled:
            for name, optimizer in optimizers.optimizers.items():
                gradients = [parameter.grad for parameter in parameters_of(optimizer)]
                watched += [(name, gradient) for gradient in gradients if gradient is not None and gradient.numel() > 0]
        names, tensors = [list(column) for column in zip(*watched, strict=True)]
        names, tensors, sizes = self._share(names, tensors, torch.stack(torch._foreach_norm(tensors, math.inf)))
        self._verdict = _Verdict(self.step, names, tensors, sizes, None)
        if not gradients_are_scaled and optimizers.all_fused:
            verdict = (~(sizes <= MAX_GRADIENT)).any().float()  # NaN compares as false
            for optimizer in optimizers.optimizers.values():
                optimizer.found_inf = verdict
            self._silence_densification()
            if sizes.is_cuda:
                self._send_home(self._verdict)
        else:
            self.settle()

    def _out_of_sight(self) -> bool:
        """Whether nothing has been visible for long."""
        return not self.in_sight.see(getattr(self.model, "info", {}))

    def _share(self, names: list[str], tensors: list[Tensor], sizes: Tensor) -> tuple[list[str], list[Tensor], Tensor]:
        """Here joins in what other devices have found, where there are any (`distributed`)."""
        return names, tensors, sizes

    def _send_home(self, verdict: _Verdict) -> None:
        """Copy a verdict's sizes to the host without waiting for them."""
        if self._in_host_memory is None or self._in_host_memory.shape != verdict.sizes.shape:
            self._in_host_memory = torch.empty_like(verdict.sizes, device="cpu", pin_memory=True)
            self._arrival = torch.cuda.Event()
        verdict.sizes = self._in_host_memory.copy_(verdict.sizes, non_blocking=True)
        verdict.arrived = self._arrival
        verdict.arrived.record()

    def settle(self) -> None:
        """Read the verdict on the step before.

        Raises:
            TrainingStopped: it was condemned.
        """
        verdict, self._verdict = self._verdict, None
        if verdict is None:
            return
        if verdict.arrived is not None:
            verdict.arrived.synchronize()
        sizes = verdict.sizes.tolist()
        findings = [
            Finding(self._full_name(name, tensor), size, tensor)
            for name, size, tensor in zip(verdict.names, sizes, verdict.tensors, strict=True)
            if not size <= MAX_GRADIENT
        ]
        if findings:
            message = report(self.pipeline, verdict.step, findings, MAX_GRADIENT)
            message += (
                f"\nThe update of step {verdict.step} was not made. The state before it is in that step's checkpoint; "
                "with --load-dir, training goes on from there."
            )
            raise TrainingStopped(message, verdict.step)

    def _full_name(self, name: str, tensor: Tensor) -> str:
        """Of a gradient, known by its optimiser's name only: which parameter's it is."""
        if name in self.model.watched:
            return name
        owners = [owner for owner, parameter in self.pipeline.named_parameters() if parameter.grad is tensor]
        if not owners and name in self.model.gauss_params:  # densification has made new parameters since
            owners = [f"gauss_params.{name}"]
        return f"the gradient of {(owners or [name])[0].removeprefix('_model.')}"

    def check_parameters(self, optimizers: LeanOptimizers) -> None:
        """Look at every parameter, and take out the splats that are not finite.

        Raises:
            TrainingStopped: one is not finite. What is left is good, unless it was one of the shared weights.
        """
        named = {name: value for name, value in self.pipeline.named_parameters() if value.numel() > 0}
        sizes = torch.stack([size.float() for size in torch._foreach_norm(list(named.values()), math.inf)]).tolist()
        findings = [
            Finding(name.removeprefix("_model."), size, named[name].detach())
            for name, size in zip(named, sizes, strict=True)
            if not math.isfinite(size)
        ]
        if not findings:
            return
        message = report(self.pipeline, self.step, findings, torch.finfo(torch.float32).max)
        only_splats = all(finding.name.startswith("gauss_params.") for finding in findings)
        if only_splats:
            bad = torch.stack([_bad_rows(finding.tensor) for finding in findings]).any(0)
            remove_splats(self.model, optimizers.optimizers, bad)
            message += f"\nThe checkpoint of step {self.step} is this state without them; with --load-dir, it goes on."
        else:
            message += "\nNothing has been written: the checkpoint before, if there is one, is the last good state."
        raise TrainingStopped(message, self.step, savable=only_splats)

    def _silence_densification(self) -> None:
        """Let a gradient on the image plane that is not finite count as zero in densification's statistics."""
        means2d = getattr(self.model, "info", {}).get("means2d")
        if means2d is None or not means2d.retains_grad:  # densification is over, or needs none
            return
        for gradient in (means2d.grad, getattr(means2d, "absgrad", None)):
            if gradient is not None:
                gradient.nan_to_num_(0.0, 0.0, 0.0)


class WatchedOptimizers(LeanOptimizers):
    """The optimisers; each step is shown to the guard first.

    Args:
        config: optimiser configurations by group, as nerfstudio passes them.
        param_groups: parameters by group.
        guard: whom to ask.
        steps_per_log: steps between two learning rates that are logged.
    """

    def __init__(self, config: dict[str, Any], param_groups: dict[str, Any], guard: Guard, steps_per_log: int = 10):
        super().__init__(config, param_groups, steps_per_log)
        self.guard = guard

    def optimizer_scaler_step_some(self, grad_scaler, param_groups: list[str]) -> None:
        self.guard.before_optimizers(self, gradients_are_scaled=grad_scaler.is_enabled())
        super().optimizer_scaler_step_some(grad_scaler, param_groups)

    def load_optimizers(self, loaded_state: dict[str, Any]) -> None:
        """Nerfstudio's; the checkpoint may have brought a smaller head than these were built on."""
        weights = list(self.guard.model.head.parameters())
        if weights:
            self.hold("field", weights)
        super().load_optimizers(loaded_state)


def remove_splats(model, optimizers: Mapping[str, torch.optim.Optimizer], bad: Tensor) -> None:
    """Take splats out of the parameters, out of their optimisers' moments and out of densification's statistics.

    Args:
        model: an NrfgsModel.
        optimizers: by group; those of `gauss_params` among them.
        bad: bool [N].
    """
    take_rows(model, optimizers, (~bad).nonzero()[:, 0])


def _bad_rows(tensor: Tensor) -> Tensor:
    """Rows with a number that is not finite, bool [N]."""
    return ~torch.isfinite(tensor).reshape(len(tensor), -1).all(dim=1)
