# SPDX-License-Identifier: Apache-2.0
"""The guard: the first number of a training that is not finite stops it, with the last good state on disk.

Between the backward pass and the optimisers, the guard takes the largest absolute value of the rendered image, of each
loss and of each gradient, in one fused call. NaN, infinity, or a gradient beyond `MAX_GRADIENT` condemns the step.

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
from collections import defaultdict
from typing import Literal, NamedTuple

import torch
from gsplat.strategy.ops import remove
from torch import Tensor

from nrfgs_ns.errors import ForTheUser
from nrfgs_ns.training.optimizers import LeanOptimizers, parameters_of

MAX_GRADIENT = 2.0**63
"""Largest gradient that passes. Its square, 2^126, and Adam's mean of squares stay below float32's 2^128; beyond that
the second moment would be infinite and the parameter would never move again, in silence."""
PARAMETERS_EVERY = 100
"""Steps between two checks of the parameters."""
PATIENCE = 100
"""Steps in a row without a visible splat after which the training stops."""
HUGE = defaultdict(lambda: 1e3, scales=20.0, means=1e6, quats=math.inf)
"""Values (log-scales, scene units, logits, a head's own) that no training reaches with suitable learning rates.
Quaternions are normalised, so theirs may have any length."""

Origin = Literal["rendering", "gradient", "parameter", "elsewhere", "nothing visible", "memory"]
"""Cause of a stop; "rendering": a number in the image or a loss, "elsewhere": on another device."""


class TrainingStopped(ForTheUser, RuntimeError):
    """A training cannot go on: a number is not finite, nothing is visible, or memory has run out. A state that is
    `savable` is good."""

    def __init__(self, message: str, step: int, origin: Origin, savable: bool = True):
        super().__init__(message)
        self.step = step
        self.origin = origin
        self.savable = savable


class Watched(NamedTuple):
    """A tensor that may condemn a step."""

    name: str
    origin: Origin
    tensor: Tensor


class Verdict(NamedTuple):
    """The largest absolute values of a step's watched tensors."""

    step: int
    watched: list[Watched]
    sizes: Tensor


class Guard:
    """Watches one training."""

    def __init__(self, pipeline):
        self.pipeline, self.model = pipeline, pipeline.model
        self.step = 0
        self.blind_steps = 0
        self._verdict: Verdict | None = None
        # Pinned memory and events are expensive to make; one of each suffices, since a verdict is read before the next.
        self._in_host_memory: Tensor | None = None
        self._arrived: torch.cuda.Event | None = None

    def begin(self, step: int, optimizers: LeanOptimizers, settled_later: bool = False) -> None:
        """Read the verdict on the step before, and now and then check the parameters. Raises TrainingStopped.

        Args:
            settled_later: `step_graph.py` reads the verdict when it has prepared this step.
        """
        if not settled_later or step % PARAMETERS_EVERY == 0:
            self.settle()
        self.step = step
        self._check_number()
        self._check_visibility()
        if step % PARAMETERS_EVERY == 0:
            self.check_parameters(optimizers)

    def before_optimizers(self, optimizers: LeanOptimizers) -> None:
        """Check image, losses and gradients, and condemn the step if one is not finite: on a CPU, TrainingStopped."""
        watched = [Watched(name, "rendering", value) for name, value in self.model.watched.items()]
        for name, optimizer in optimizers.optimizers.items():
            for parameter in parameters_of(optimizer):
                if parameter.grad is not None and parameter.numel() > 0:
                    watched.append(Watched(f"the gradient of {name}", "gradient", parameter.grad))
        sizes = torch.stack(torch._foreach_norm([each.tensor for each in watched], math.inf))
        self._verdict = self._share(Verdict(self.step, watched, sizes))
        if not optimizers.all_fused:
            self.settle()
            return
        sizes = self._verdict.sizes
        condemned = (~(sizes <= MAX_GRADIENT)).any().float()  # NaN compares as false
        for optimizer in optimizers.optimizers.values():
            optimizer.found_inf = condemned
        if sizes.is_cuda:
            self._send_home(sizes)

    def _check_number(self) -> None:
        """Raise TrainingStopped where no splat is left, on any device."""
        if self.model.num_splats == 0:
            message = f"No splat is left in step {self.step}: all were pruned. Images or masks show nothing, or "
            message += "thresholds of the densification are too high."
            raise TrainingStopped(message, self.step, "nothing visible", savable=False)

    def _check_visibility(self) -> None:
        """Raise TrainingStopped where no splat was visible in the last `PATIENCE` steps: no rows, or, in recorded
        steps, where all splats have one, no pairs of splats and tiles."""
        info = getattr(self.model, "info", {})
        rows = info.get("gaussian_ids")
        blind = rows is not None and (len(rows) == 0 or info.get("pairs") == 0)
        self.blind_steps = self.blind_steps + 1 if blind else 0
        if self.blind_steps >= PATIENCE:
            message = f"No splat has been visible in the last {PATIENCE} steps, so nothing is learnt. Poses and points "
            message += "are not of one world, or a learning rate has thrown the splats out of sight (see the viewer)."
            raise TrainingStopped(message, self.step, "nothing visible")

    def _share(self, verdict: Verdict) -> Verdict:
        """Add other devices' findings (`distributed`)."""
        return verdict

    def _send_home(self, sizes: Tensor) -> None:
        """Copy the verdict's sizes to the host without waiting for them."""
        if self._in_host_memory is None or self._in_host_memory.shape != sizes.shape:
            self._in_host_memory = torch.empty_like(sizes, device="cpu", pin_memory=True)
            self._arrived = torch.cuda.Event()
        self._verdict = self._verdict._replace(sizes=self._in_host_memory.copy_(sizes, non_blocking=True))
        self._arrived.record()

    def settle(self) -> None:
        """Read the verdict on the step before; TrainingStopped if it was condemned."""
        verdict, self._verdict = self._verdict, None
        if verdict is None:
            return
        pairs = zip(verdict.watched, self._read(verdict), strict=True)
        bad = [(each, size) for each, size in pairs if not size <= MAX_GRADIENT]
        if bad:
            step = verdict.step
            findings = [(each.name, size, each.tensor) for each, size in bad]
            message = report(self.pipeline, step, findings, MAX_GRADIENT)
            message += f"\nThe update of step {step} was not made. The state before it is in that step's checkpoint; "
            raise TrainingStopped(f"{message}with --load-dir, training goes on from there.", step, bad[0][0].origin)

    def _read(self, verdict: Verdict) -> list[float]:
        """Wait for a verdict's sizes."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return verdict.sizes.tolist()

    def check_parameters(self, optimizers: LeanOptimizers) -> None:
        """Remove the splats that are not finite and raise TrainingStopped, savable unless a shared weight is not finite
        either, or no splat is left."""
        self._check_number()
        findings = [
            (name.removeprefix("_model."), size, value.detach())
            for name, value in self.pipeline.named_parameters()
            if value.numel() > 0 and not math.isfinite(size := value.norm(math.inf).item())
        ]
        if not findings:
            return
        largest = torch.finfo(torch.float32).max
        message = report(self.pipeline, self.step, findings, largest)
        splats = [_within(values, largest) for name, _, values in findings if name.startswith("gauss_params.")]
        if savable := len(splats) == len(findings) and bool((kept := torch.stack(splats).all(0)).any()):
            remove(self.model.gauss_params, optimizers.optimizers, self.model.densification.state, ~kept)
            message += f"\nThe checkpoint of step {self.step} is this state without them; with --load-dir, it goes on."
        else:
            message += "\nNothing has been written: the checkpoint before, if there is one, is the last good state."
        raise TrainingStopped(message, self.step, "parameter", savable)


def report(pipeline, step: int, findings: list[tuple[str, float, Tensor]], limit: float) -> str:
    """The message of a stop: the first tensor, its splats, and the likely cause. `findings` are a tensor's name, its
    largest absolute value (NaN, infinite or beyond the limit), and its values."""
    model = pipeline.model
    first, size, _ = findings[0]
    what = "has NaN" if math.isnan(size) else "is infinite"
    if math.isfinite(size):
        what = f"reaches {size:.2g}, which Adam cannot square"
    lines = [f"Training stopped at step {step}: {first} {what}."]
    for name, _, values in findings:
        if name.removeprefix("the gradient of ").removeprefix("gauss_params.") in model.gauss_params:
            rows = (~_within(values, limit)).nonzero().flatten().tolist()
            shown = ", ".join(map(str, rows[:3])) + (", ..." if len(rows) > 3 else "")
            lines.append(f"{name}: {len(rows)} of {len(values)} splats, first {shown}.")
            break
    index = getattr(model, "watched_image", None)
    image = "of this step" if index is None else pipeline.datamanager.train_dataset.image_filenames[index]
    return "\n".join([*lines, f"Likely cause: {_cause(model, [name for name, _, _ in findings], image)}"])


def _within(tensor: Tensor, limit: float) -> Tensor:
    """Rows whose numbers are finite and at most `limit` in absolute value, bool [N]."""
    return (tensor.abs() <= limit).reshape(len(tensor), -1).all(dim=1)


def _cause(model, names: list[str], image: object) -> str:
    """The likeliest cause of non-finite tensors, and what to do about it."""
    if "loss main_loss" in names and "the rendered image" not in names:
        return f"the rendering is finite and its loss is not, so the image or mask is broken: {image}. Replace it."
    for group, value in (*model.gauss_params.items(), *(("field", weight) for weight in model.head.parameters())):
        if value.numel() and not (reached := value.abs().max().item()) <= HUGE[group]:  # or NaN
            return (
                f"a learning rate that is too high: {group} have reached {reached:.2g}. Lower "
                f"--optimizers.{group}.optimizer.lr and start from an older checkpoint."
            )
    return f"not clear. The image was {image}: check it and its pose, then lower the learning rates."
