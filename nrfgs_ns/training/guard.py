# SPDX-License-Identifier: Apache-2.0
"""The guard: the first number of a training that is not finite stops it, with the last good state on disk.

Between the backward pass and the optimisers, the guard takes the largest absolute value of the rendered image, of each
loss and of each gradient, all in one fused call. NaN, infinity, or a gradient beyond `MAX_GRADIENT` condemns the step.

- On a CPU the training stops before the optimisers step.
- On a GPU, reading the numbers would make the host wait in every step. Instead the verdict stays on the device, where
  fused Adam reads it (`found_inf`) and leaves parameters and moments as they are. A copy travels to the host meanwhile
  and is read before the next step is computed. With an optimiser that cannot read the verdict, the host waits.

Either way the remaining state is that before the condemned step, and the trainer writes it as that step's checkpoint.
On a GPU, densification may have run in between; gradients that are not finite enter its statistics as zero.

Parameters are checked before each checkpoint and every `PARAMETERS_EVERY` steps. Splats that are not finite (the
rasterizer does not draw them, so no gradient shows them) are removed before the checkpoint is written.
"""

import math
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
"""Cause of a stop; "rendering": a number in the image or a loss, "elsewhere": on another device."""


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
class Watched:
    """A tensor that may condemn a step."""

    name: str
    """of a gradient: its optimiser's"""
    origin: Origin
    tensor: Tensor
    owner: Tensor | None = None
    """of a gradient: its parameter"""


@dataclass
class Verdict:
    """The largest absolute values of a step's watched tensors, in host memory once `arrived` has happened."""

    step: int
    watched: list[Watched]
    sizes: Tensor
    arrived: torch.cuda.Event | None = None


@dataclass
class Finding:
    """A tensor that condemned a step, with its largest absolute value: NaN, infinite, or too large."""

    name: str
    size: float
    tensor: Tensor


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

    def begin(self, step: int, optimizers: LeanOptimizers, settled_later: bool = False) -> None:
        """Read the verdict on the step before, and now and then check the parameters. Raises TrainingStopped.

        Args:
            settled_later: `step_graph.py` reads the verdict when it has prepared this step.
        """
        if not settled_later or step % PARAMETERS_EVERY == 0:
            self.settle()
        self.step = step
        self._check_visibility()
        if step % PARAMETERS_EVERY == 0:
            self.check_parameters(optimizers)

    def before_optimizers(self, optimizers: LeanOptimizers, gradients_are_scaled: bool) -> None:
        """Check image, losses and gradients, and condemn the step if one is not finite: on a CPU, TrainingStopped.

        Args:
            gradients_are_scaled: only image and losses are checked; a GradScaler skips steps with infinite gradients.
        """
        watched = [Watched(name, "rendering", value) for name, value in self.model.watched.items()]
        for name, optimizer in optimizers.optimizers.items() if not gradients_are_scaled else ():
            for parameter in parameters_of(optimizer):
                if parameter.grad is not None and parameter.numel() > 0:
                    watched.append(Watched(name, "gradient", parameter.grad, parameter))
        sizes = torch.stack(torch._foreach_norm([each.tensor for each in watched], math.inf))
        self._verdict = self._share(Verdict(self.step, watched, sizes))
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

    def _check_visibility(self) -> None:
        """Raise TrainingStopped where no splat is left, or none was visible in the last `PATIENCE` steps: no rows, or,
        where all splats have one (`step_graph.py`), no pairs of splats and tiles."""
        if self.model.num_points == 0:
            message = (
                f"No splat is left in step {self.step}: all were pruned. Images or masks show nothing, or thresholds "
                "of the densification are too high."
            )
            raise TrainingStopped(message, self.step, "nothing visible", savable=False)
        info = getattr(self.model, "info", {})
        rows = info.get("gaussian_ids")
        blind = rows is not None and (len(rows) == 0 or info.get("pairs") == 0)
        self.blind_steps = self.blind_steps + 1 if blind else 0
        if self.blind_steps >= PATIENCE:
            message = (
                f"No splat has been visible in the last {PATIENCE} steps, so nothing is learnt. Poses and points are "
                "not of one world, or a learning rate has thrown the splats out of sight (see the viewer)."
            )
            raise TrainingStopped(message, self.step, "nothing visible")

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
        """Read the verdict on the step before; TrainingStopped if it was condemned."""
        verdict, self._verdict = self._verdict, None
        if verdict is None:
            return
        pairs = zip(verdict.watched, self._read(verdict), strict=True)
        bad = [(each, size) for each, size in pairs if not size <= MAX_GRADIENT]
        if bad:
            findings = [Finding(self._full_name(each), size, each.tensor) for each, size in bad]
            message = report(self.pipeline, verdict.step, findings, MAX_GRADIENT)
            message += (
                f"\nThe update of step {verdict.step} was not made. The state before it is in that step's checkpoint; "
                "with --load-dir, training goes on from there."
            )
            raise TrainingStopped(message, verdict.step, bad[0][0].origin)

    def _read(self, verdict: Verdict) -> list[float]:
        """A verdict's sizes, for which the host waits."""
        if verdict.arrived is not None:
            verdict.arrived.synchronize()
        return verdict.sizes.tolist()

    def _full_name(self, watched: Watched) -> str:
        """The name of a gradient's parameter, given its optimiser's; other names stay."""
        if watched.owner is None:
            return watched.name
        names = [name for name, parameter in self.pipeline.named_parameters() if parameter is watched.owner]
        if not names and watched.name in self.model.gauss_params:  # densification has made new parameters since
            names = [f"gauss_params.{watched.name}"]
        return f"the gradient of {(names or [watched.name])[0].removeprefix('_model.')}"

    def check_parameters(self, optimizers: LeanOptimizers) -> None:
        """Check every parameter, and remove the splats that are not finite.

        Raises:
            TrainingStopped: one is not finite. It is savable unless it is a shared weight.
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
            good = torch.stack([_within(finding.tensor, torch.finfo(torch.float32).max) for finding in findings]).all(0)
            take_rows(self.model, optimizers.optimizers, good.nonzero()[:, 0])
            message += f"\nThe checkpoint of step {self.step} is this state without them; with --load-dir, it goes on."
        else:
            message += "\nNothing has been written: the checkpoint before, if there is one, is the last good state."
        raise TrainingStopped(message, self.step, "parameter", savable=only_splats)

    def _silence_densification(self) -> None:
        """Set gradients on the image plane that are not finite to zero for densification's statistics."""
        means2d = getattr(self.model, "info", {}).get("means2d")
        if means2d is not None and means2d.retains_grad:  # densification needs them
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
