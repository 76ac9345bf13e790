# SPDX-License-Identifier: Apache-2.0
"""The guard: the first number of a training that is not finite stops it, with the last good state on disk.

Between the backward pass and the optimisers, the guard takes the largest absolute value of the rendered image, of each
loss and of each gradient, all in one fused call. NaN, infinity, or a gradient beyond `MAX_GRADIENT` (which Adam cannot
square) condemns the step. What happens then:

- On a CPU the training stops before the optimisers step.
- On a GPU, reading the numbers would make the host wait in every step. Instead the verdict stays on the device, where
  fused Adam reads it (`found_inf`) and leaves parameters and moments as they are. A copy travels to the host meanwhile
  and is read before the next step is computed. An optimiser that cannot read the verdict on the device is treated as on
  a CPU, waiting included.

Either way the remaining parameters and moments are those from before the condemned step, and the trainer writes them as
that step's checkpoint: a training continued from it has skipped the step. On a GPU, densification may have run in
between; gradients that are not finite enter its statistics as zero.

Parameters are checked before each checkpoint and every `PARAMETERS_EVERY` steps. Splats that are not finite (the
rasterizer does not draw them, so no gradient shows them) are removed before the checkpoint is written.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from nrfgs_ns.densification.rows import take_rows
from nrfgs_ns.errors import ForTheUser
from nrfgs_ns.training.optimizers import LeanOptimizers, parameters_of

MAX_GRADIENT = 2.0**63
"""Largest gradient that passes. Its square, 2^126, and Adam's mean of squares stay below float32's 2^128; beyond that
the second moment would be infinite and the parameter would never move again, in silence."""
PARAMETERS_EVERY = 100
"""Steps between two checks of the parameters."""
PATIENCE = 100
"""Steps in a row without a visible splat after which the training stops."""
SHOWN = 3
"""Splats named in a message."""
HUGE_BY_GROUP = {"scales": 20.0, "means": 1e6, "quats": math.inf}
"""Values (log-scales, scene units) that no training reaches with suitable learning rates. Quaternions are normalised,
so theirs may have any length."""
HUGE = 1e3
"""The same for all other tensors: logits, a head's per-splat tensors, shared weights."""

Origin = Literal["rendering", "gradient", "parameter", "elsewhere", "nothing visible", "memory"]
"""Cause of a stop: a number in the image or a loss, in a gradient or a parameter, or on another device; that nothing is
visible; or that the memory has run out."""


class TrainingStopped(ForTheUser, RuntimeError):
    """A training cannot go on: it met a number that is not finite, sees nothing, or its memory has run out.

    Args:
        savable: whether the remaining state is good.
    """

    def __init__(self, message: str, step: int, origin: Origin, savable: bool = True):
        super().__init__(message)
        self.step = step
        self.origin = origin
        self.savable = savable


@dataclass
class Finding:
    """A tensor that condemned a step."""

    name: str
    size: float
    """its largest absolute value: NaN, infinite, or too large"""
    tensor: Tensor


@dataclass
class Verdict:
    """The largest absolute values of a step, on their way to the host."""

    step: int
    names: list[str]
    """names of the tensors; of gradients, their optimiser's"""
    origins: list[Origin]
    tensors: list[Tensor]
    sizes: Tensor
    """largest absolute values, in host memory once `arrived` has happened"""
    arrived: torch.cuda.Event | None
    owners: list[Tensor | None]
    """of gradients, their parameters"""


class Guard:
    """Watches one training."""

    def __init__(self, pipeline):
        self.pipeline = pipeline
        self.step = 0
        self.blind_steps = 0
        self._verdict: Verdict | None = None
        # Pinned memory and events are expensive to make; one of each suffices, since a verdict is read before the next.
        self._in_host_memory: Tensor | None = None
        self._arrival: torch.cuda.Event | None = None

    @property
    def model(self):
        return self.pipeline.model

    def before_first_step(self, step: int, optimizers: LeanOptimizers) -> None:
        """Check the parameters before a training begins, or goes on, at a step."""
        self.step = step
        self.check_parameters(optimizers)

    def begin(self, step: int, optimizers: LeanOptimizers, settled_later: bool = False) -> None:
        """Read the verdict on the step before, and now and then check the parameters.

        Args:
            settled_later: `step_graph.py` reads the verdict when it has prepared this step.

        Raises:
            TrainingStopped: the step before was condemned, a parameter is not finite, or nothing is visible any more.
        """
        if not settled_later or step % PARAMETERS_EVERY == 0:
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
        """Check image, losses and gradients, and condemn the step if one is not finite.

        Args:
            gradients_are_scaled: a GradScaler meets infinite gradients as a matter of course and skips such steps
                itself: only the image and the losses are checked.

        Raises:
            TrainingStopped: on a CPU, if the step is condemned.
        """
        watched: list[tuple[str, Origin, Tensor, Tensor | None]]
        watched = [(name, "rendering", value, None) for name, value in self.model.watched.items()]
        if not gradients_are_scaled:
            for name, optimizer in optimizers.optimizers.items():
                for parameter in parameters_of(optimizer):
                    if parameter.grad is not None and parameter.numel() > 0:
                        watched.append((name, "gradient", parameter.grad, parameter))
        names, origins, tensors, owners = [list(column) for column in zip(*watched, strict=True)]
        sizes = torch.stack(torch._foreach_norm(tensors, math.inf))
        self._verdict = self._share(Verdict(self.step, names, origins, tensors, sizes, None, owners))
        sizes = self._verdict.sizes
        if gradients_are_scaled or not optimizers.all_fused:
            self.settle()
            return
        condemned = (~(sizes <= MAX_GRADIENT)).any().float()  # NaN compares as false
        for optimizer in optimizers.optimizers.values():
            optimizer.found_inf = condemned
        self._silence_densification()
        if sizes.is_cuda:
            self._send_home(self._verdict)

    def _is_empty(self) -> bool:
        """Whether no splat is left."""
        return self.model.num_points == 0

    def _out_of_sight(self) -> bool:
        """Whether nothing has been visible in the last `PATIENCE` steps: no rows, or, where all splats have one
        (`step_graph.py`), no pairs of splats and tiles."""
        info = getattr(self.model, "info", {})
        rows = info.get("gaussian_ids")
        blind = rows is not None and (len(rows) == 0 or info.get("pairs") == 0)
        self.blind_steps = self.blind_steps + 1 if blind else 0
        return self.blind_steps >= PATIENCE

    def _share(self, verdict: Verdict) -> Verdict:
        """Add other devices' findings, where there are any (`distributed`)."""
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
        """The name of a gradient's parameter, given its optimiser's; other names stay."""
        if owner is None:
            return name
        owners = [known for known, parameter in self.pipeline.named_parameters() if parameter is owner]
        if not owners and name in self.model.gauss_params:  # densification has made new parameters since
            owners = [f"gauss_params.{name}"]
        return f"the gradient of {(owners or [name])[0].removeprefix('_model.')}"

    def check_parameters(self, optimizers: LeanOptimizers) -> None:
        """Check every parameter, and remove the splats that are not finite.

        Raises:
            TrainingStopped: one is not finite. The rest is good, unless it was one of the shared weights.
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
            bad = torch.stack([~_within(finding.tensor, torch.finfo(torch.float32).max) for finding in findings]).any(0)
            remove_splats(self.model, optimizers.optimizers, bad)
            message += f"\nThe checkpoint of step {self.step} is this state without them; with --load-dir, it goes on."
        else:
            message += "\nNothing has been written: the checkpoint before, if there is one, is the last good state."
        raise TrainingStopped(message, self.step, "parameter", savable=only_splats)

    def _silence_densification(self) -> None:
        """Set gradients on the image plane that are not finite to zero for densification's statistics."""
        means2d = getattr(self.model, "info", {}).get("means2d")
        if means2d is None or not means2d.retains_grad:  # densification is over, or needs none
            return
        for gradient in (means2d.grad, getattr(means2d, "absgrad", None)):
            if gradient is not None:
                gradient.nan_to_num_(0.0, 0.0, 0.0)


class WatchedOptimizers(LeanOptimizers):
    """The optimisers, behind the guard."""

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
    """Remove splats from the parameters, their optimisers' moments and densification's statistics.

    Args:
        optimizers: by group; those of `gauss_params` among them.
        bad: bool [N].
    """
    take_rows(model, optimizers, (~bad).nonzero()[:, 0])


def report(pipeline, step: int, findings: list[Finding], limit: float) -> str:
    """The message of a stop: tensors, splats, and the likely cause."""
    first, others = findings[0], ", ".join(finding.name for finding in findings[1:4])
    what = f"reaches {first.size:.2g}, which Adam cannot square"
    if not math.isfinite(first.size):
        what = "has NaN" if math.isnan(first.size) else "is infinite"
    lines = [f"Training stopped at step {step}: {first.name} {what}." + (f" Also: {others}." if others else "")]
    per_splat = next((finding for finding in findings if "gauss_params." in finding.name), None)
    if per_splat is not None:
        rows = (~_within(per_splat.tensor, limit)).nonzero().flatten().tolist()
        shown = ", ".join(map(str, rows[:SHOWN])) + (", ..." if len(rows) > SHOWN else "")
        lines.append(f"{per_splat.name}: {len(rows)} of {len(per_splat.tensor)} splats, first {shown}.")
    return "\n".join([*lines, f"Likely cause: {_cause(pipeline, [finding.name for finding in findings])}"])


def _within(tensor: Tensor, limit: float) -> Tensor:
    """Rows whose numbers are finite and at most `limit` in absolute value, bool [N]."""
    return (tensor.abs() <= limit).reshape(len(tensor), -1).all(dim=1)


def _cause(pipeline, names: list[str]) -> str:
    """The likeliest cause of non-finite tensors, and what to do about it."""
    model = pipeline.model
    index = getattr(model, "watched_image", None)
    image = "of this step" if index is None else pipeline.datamanager.train_dataset.image_filenames[index]
    for name, value in model.named_parameters():
        if value.numel() and not bool(torch.isfinite(value).all()):
            return (
                f"the parameter {name} is not finite. It was loaded or edited so, or an update overflowed: go back to "
                "an older checkpoint, and lower its learning rate if it happens again."
            )
    if "loss main_loss" in names and "the rendered image" not in names:
        return f"the rendering is finite and its loss is not, so the image or mask is broken: {image}. Replace it."
    sizes = [(name, value, HUGE_BY_GROUP.get(name, HUGE)) for name, value in model.gauss_params.items()]
    sizes += [("field", weight, HUGE) for weight in model.head.parameters()]
    for group, value, huge in sizes:
        if value.numel() and (reached := float(value.abs().max())) > huge:
            return (
                f"a learning rate that is too high: {group} have reached {reached:.2g}. Lower "
                f"--optimizers.{group}.optimizer.lr and start from an older checkpoint."
            )
    return f"not clear. The image was {image}: check it and its pose, then lower the learning rates."
