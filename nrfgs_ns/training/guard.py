# SPDX-License-Identifier: Apache-2.0
"""The guard: the first number of a training that is not finite stops it, with the last good state on disk.

Between the backward pass and the optimisers, the guard takes the largest absolute value of the rendered image, of each
loss and of each gradient, all in one fused call. NaN, infinity, or a gradient beyond `MAX_GRADIENT` (which Adam cannot
square) condemns the step. What happens then:

- On a CPU, the numbers are at hand: the training stops before the optimisers step.
- On a GPU, reading them would make the host wait in every step. Instead the verdict stays on the device, where fused
  Adam reads it (`found_inf`) and leaves parameters and moments as they are. A copy travels to the host meanwhile and is
  read before the next step is computed: when all is ready for that, in a step of `step_graph.py`, and at its head in
  one whose projection would wait for the same work anyway. An optimiser that cannot read
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
from typing import Any, Literal

import torch
from torch import Tensor

from nrfgs_ns.densification.rows import take_rows
from nrfgs_ns.errors import ForTheUser
from nrfgs_ns.training.guard_report import Finding, report
from nrfgs_ns.training.optimizers import LeanOptimizers, parameters_of

MAX_GRADIENT = 2.0**63
"""Largest gradient that is let through. Its square, 2^126, and Adam's mean of squares stay below float32's 2^128; from
there on the second moment would be infinite and the parameter would never move again, in silence."""
PARAMETERS_EVERY = 100
"""Steps between two looks at the parameters."""
PATIENCE = 100
"""Steps in a row, each with another view's turn, without a visible splat after which there will be none."""

Origin = Literal["rendering", "gradient", "parameter", "elsewhere", "nothing visible", "memory"]
"""What stops a training: a number in the image or a loss, in a gradient or a parameter, or on another device; that
nothing is visible; or that the memory has run out."""


class TrainingStopped(ForTheUser, RuntimeError):
    """A training cannot go on: it met a number that is not finite, sees nothing, or its memory has run out.

    Args:
        savable: whether the state that is left is good.
    """

    def __init__(self, message: str, step: int, origin: Origin, savable: bool = True):
        super().__init__(message)
        self.step = step
        self.origin = origin
        self.savable = savable


@dataclass
class Verdict:
    """A step that has been looked at, and whose numbers are on their way to the host."""

    step: int
    names: list[str]
    """what was looked at; of gradients, the name of their optimiser"""
    origins: list[Origin]
    tensors: list[Tensor]
    sizes: Tensor
    """largest absolute values, in host memory once `arrived` has happened"""
    arrived: torch.cuda.Event | None
    owners: list[Tensor | None]
    """the parameters whose gradients were looked at"""


class Guard:
    """Watches one training."""

    def __init__(self, pipeline):
        self.pipeline = pipeline
        self.step = 0
        self.blind_steps = 0
        self._verdict: Verdict | None = None
        # Pinned memory and events are dear to make; one of each will do, for a verdict is read before the next is made.
        self._in_host_memory: Tensor | None = None
        self._arrival: torch.cuda.Event | None = None

    @property
    def model(self):
        return self.pipeline.model

    def before_first_step(self, step: int, optimizers: LeanOptimizers) -> None:
        """A training is about to begin, or to go on, at a step: its parameters must be finite."""
        self.step = step
        self.check_parameters(optimizers)

    def begin(self, step: int, optimizers: LeanOptimizers) -> None:
        """Head of a training step: learn about the step before, unless `step_graph.py` will ask when it has prepared
        this one, and now and then look at the parameters.

        Raises:
            TrainingStopped: the step before was condemned, a parameter is not finite, or nothing is visible any more.
        """
        if self.pipeline.graphs is None or step % PARAMETERS_EVERY == 0:
            self.settle()
        self.step = step
        if self._is_empty():
            raise TrainingStopped(
                f"No splat is left in step {step}: all were pruned. Images or masks show nothing, or thresholds of the "
                "densification are too high.",
                step,
                "nothing visible",
                savable=False,
            )
        if self._out_of_sight():
            raise TrainingStopped(
                f"No splat has been visible in the last {PATIENCE} steps, so nothing is learnt. Poses and points are "
                "not of one world, or a learning rate has thrown the splats out of sight. The viewer shows where the "
                "cameras are.",
                step,
                "nothing visible",
            )
        if step % PARAMETERS_EVERY == 0:
            self.check_parameters(optimizers)

    def before_optimizers(self, optimizers: LeanOptimizers, gradients_are_scaled: bool) -> None:
        """Look at image, losses and gradients, and condemn the step if one is not finite.

        Args:
            gradients_are_scaled: a GradScaler is at work, which meets infinite gradients as a matter of course and
                skips such steps itself: only the image and the losses are looked at.

        Raises:
            TrainingStopped: on a CPU, if the step is condemned.
        """
        watched: list[tuple[str, Origin, Tensor, Tensor | None]]
        watched = [(name, "rendering", value, None) for name, value in self.model.watched.items()]
        if not gradients_are_scaled:
            for name, optimizer in optimizers.optimizers.items():
                found = [one for one in parameters_of(optimizer) if one.grad is not None and one.numel() > 0]
                watched += [(name, "gradient", parameter.grad, parameter) for parameter in found]
        names, origins, tensors, owners = [list(column) for column in zip(*watched, strict=True)]
        sizes = torch.stack(torch._foreach_norm(tensors, math.inf))
        own = Verdict(self.step, names, origins, tensors, sizes, None, owners)
        self._verdict = self._share(own)
        sizes = self._verdict.sizes
        if not gradients_are_scaled and optimizers.all_fused:
            verdict = (~(sizes <= MAX_GRADIENT)).any().float()  # NaN compares as false
            for optimizer in optimizers.optimizers.values():
                optimizer.found_inf = verdict
            self._silence_densification()
            if sizes.is_cuda:
                self._send_home(self._verdict)
        else:
            self.settle()

    def _is_empty(self) -> bool:
        """Whether no splat is left."""
        return self.model.num_points == 0

    def _out_of_sight(self) -> bool:
        """Whether nothing has been visible in the last `PATIENCE` steps. The host knows how many rows there were, or
        where all splats have one (`step_graph.py`) how many pairs of splats and tiles."""
        info = getattr(self.model, "info", {})
        rows = info.get("gaussian_ids")
        blind = rows is not None and (len(rows) == 0 or info.get("pairs") == 0)
        self.blind_steps = self.blind_steps + 1 if blind else 0
        return self.blind_steps >= PATIENCE

    def _share(self, verdict: Verdict) -> Verdict:
        """Here joins in what other devices have found, where there are any (`distributed`)."""
        return verdict

    def _send_home(self, verdict: Verdict) -> None:
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
        sizes = self._read(verdict)
        bad = [row for row, size in enumerate(sizes) if not size <= MAX_GRADIENT]
        if bad:
            findings = [
                Finding(self._full_name(verdict.names[row], verdict.owners[row]), sizes[row], verdict.tensors[row])
                for row in bad
            ]
            message = report(self.pipeline, verdict.step, findings, MAX_GRADIENT)
            message += (
                f"\nThe update of step {verdict.step} was not made. The state before it is in that step's checkpoint; "
                "with --load-dir, training goes on from there."
            )
            raise TrainingStopped(message, verdict.step, verdict.origins[bad[0]])

    def _read(self, verdict: Verdict) -> list[float]:
        """A verdict's sizes, for which the host waits."""
        if verdict.arrived is not None:
            verdict.arrived.synchronize()
        return verdict.sizes.tolist()

    def _full_name(self, name: str, owner: Tensor | None) -> str:
        """Of a gradient, known by its optimiser's name only: which parameter's it is."""
        if owner is None:
            return name
        owners = [known for known, parameter in self.pipeline.named_parameters() if parameter is owner]
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
        raise TrainingStopped(message, self.step, "parameter", savable=only_splats)

    def _silence_densification(self) -> None:
        """Let a gradient on the image plane that is not finite count as zero in densification's statistics."""
        means2d = getattr(self.model, "info", {}).get("means2d")
        if means2d is None or not means2d.retains_grad:  # densification is over, or needs none
            return
        for gradient in (means2d.grad, getattr(means2d, "absgrad", None)):
            if gradient is not None:
                gradient.nan_to_num_(0.0, 0.0, 0.0)


class WatchedOptimizers(LeanOptimizers):
    """The optimisers; each step is shown to the guard first."""

    def __init__(self, guard: Guard, *args: Any):
        super().__init__(*args)
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
        optimizers: by group; those of `gauss_params` among them.
        bad: bool [N].
    """
    take_rows(model, optimizers, (~bad).nonzero()[:, 0])


def _bad_rows(tensor: Tensor) -> Tensor:
    """Rows with a number that is not finite, bool [N]."""
    return ~torch.isfinite(tensor).reshape(len(tensor), -1).all(dim=1)
