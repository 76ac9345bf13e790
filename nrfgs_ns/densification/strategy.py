# SPDX-License-Identifier: Apache-2.0
"""The interface of all strategies of densification: their options, and what runs in training.

A strategy is a dataclass of its options (`DensificationConfig`), which builds what runs (`Densification`). What it
wants of the head or of the loss it says itself. A new one is one file, and its name in `__init__.py`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, MutableMapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from nrfgs_ns.data.checks import warn
from nrfgs_ns.densification import memory
from nrfgs_ns.errors import require

OpacitySeen = Literal["base", "peak"]
"""Opacity of a splat that decides what becomes of it: the stored one, or the largest that a view has shown lately."""

Splats = MutableMapping[str, Parameter]
"""A table; entries are replaced."""
Optimizers = Mapping[str, Optimizer]
"""One for each entry of a table, under its name, with one parameter group; others are left alone."""

CHANGE = "opacity_change"
"""Name, in a strategy's `state`, of the largest change of each splat's opacity by a view, [N]: see `change_of`."""
CHANGE_BEFORE = CHANGE + "_before"
"""The same in the window before, for strategies that look at two (`begin_another_window`)."""
GROWTH_LIMIT = "held_at"
"""Name, in a strategy's `state`, of a pair: the number of splats at which growth ended because memory was short, and
the bytes that the process was allowed then; None: memory was never short."""
NEAR_LIMIT = 1.1
"""An estimate of the most splats ends growth only once their number times this reaches it: before, it is too low,
because it takes memory that does not grow, such as images, for memory of splats."""
FIRST_COUNT = "first_count"
"""Name, in a strategy's `state`, of the number of splats at the first refinement, where a budget's growth starts."""
UNSEEN = -2.0
"""Change of a splat that no view has shown: less than any change."""


def change_of(stored: Tensor, shown: Tensor) -> Tensor:
    """How views change stored opacities: the amount that they add, or, negative, the share that they take away.

    It grows with the opacity that is shown, and is 0 where that is the stored one. What is taken away is a share,
    because no view takes more than there is: a splat of 0.6 that a view shows at 0.3 is still visible once relocation
    has left it 0.2.

    Args:
        stored, shown: opacities in [0, 1] of one shape.

    Returns:
        Numbers in [-1, 1].
    """
    added = shown - stored
    return torch.where(added < 0, added / stored, added)


def shown_opacity(stored: Tensor, change: Tensor) -> Tensor:
    """The inverse of `change_of`: opacities in [0, 1]; the stored ones where the change is `UNSEEN`."""
    change = torch.where(change > UNSEEN, change, 0.0)
    return torch.where(change < 0, stored * (1 + change), stored + change).clamp_max(1.0)


@dataclass
class DensificationConfig(ABC):
    """Options of a strategy; each has a `budget`, too, the number of splats to grow to (0: as many as the rules give).
    Steps count from 0; `reschedule` stretches them to the training."""

    name: ClassVar[str]
    """what it is called on the command line and in checkpoints"""
    copies_splats: ClassVar[bool] = False
    """replaces splats by ones that share their opacity, which heads adapt to (`AppearanceHeadConfig.for_copies`)"""
    regularises: ClassVar[bool] = False
    """adds terms for opacity and size to the loss, in place of the model's `shrinkage`"""
    shrinkage: ClassVar[float] = 0.0
    """weight that it adds to the model's `shrinkage`, in percent, however many training views there are"""
    counts: ClassVar[tuple[str, ...]] = ("budget",)
    """options that are numbers of splats"""
    opacity_seen: OpacitySeen = "base"
    """opacity by which splats are pruned or replaced (docs/deviations.md). base: stored. peak: largest shown lately"""
    warmup_length: int = 500
    """step after which refinement begins"""
    refine_every: int = 100
    """steps between refinements"""

    @abstractmethod
    def build(self, num_images: int, num_views: int, scene_unit: float) -> "Densification":
        """The strategy for a training.

        Args:
            num_images: number of training images.
            num_views: number of different views among them.
            scene_unit: world units in a scene unit, in which sizes among the options are.
        """

    def check(self) -> None:
        """Raise InputError where an option is out of range."""
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, (int, float)):
                self.require(0 <= value < math.inf, field.name, "zero or positive")
        self.require(self.opacity_seen in get_args(OpacitySeen), "opacity_seen", "base or peak")
        self.require(self.refine_every >= 1, "refine_every", "at least 1")

    def require(self, holds: bool, name: str, needed: str) -> None:
        """Raise InputError naming option `name`, its value and what is `needed`, unless the condition holds."""
        require(holds, f"--pipeline.model.densification {self.name}: {name}", getattr(self, name), needed)

    def share_of(self, rank: int, devices: int) -> "DensificationConfig":
        """The options for one of several devices, each of which has a part of the splats."""
        return replace(self, **{name: len(range(rank, getattr(self, name), devices)) for name in self.counts})

    def __str__(self) -> str:
        """The option's value on the command line: the name, then options that are not at their defaults."""
        changed = ((field.name, getattr(self, field.name)) for field in fields(self))
        default = type(self)()
        return ",".join([self.name, *(f"{n}={v}" for n, v in changed if v != getattr(default, n))])


class Densification(ABC):
    """What the model asks of a strategy. `state` is all that a continued training needs, and goes into checkpoints.

    Args:
        config: its options.
        windows: between refinements, 1 or 2, whose views `seen_opacity` looks at.
    """

    state: dict[str, Any]
    """Numbers, tuples of them, tensors with a row per splat, or None for what the first step has to make."""
    verbose: bool = True
    """Whether refinements are printed."""
    pixels: int = 0
    """Number of pixels of the largest photograph."""
    gradients: Literal["none", "signed", "absolute"] = "none"
    """Screen-space gradients that it needs until it rests; absolute: sums over pixels of absolute values (AbsGS)."""
    trainings: int = 1
    """Trainings that grow in the same memory at once."""
    moved_at: int | None = None
    """Last step at which rows of the table came to denote other splats although no tensor was replaced."""

    def __init__(self, config: DensificationConfig, windows: int = 1):
        self.config, self.name, self.opacity_seen = config, config.name, config.opacity_seen
        self.budget: int = config.budget
        """Number of splats to grow to; 0: as many as the rules give."""
        seen = (CHANGE, CHANGE_BEFORE)[:windows] if self.opacity_seen == "peak" else ()
        self.state = {GROWTH_LIMIT: None, **dict.fromkeys((FIRST_COUNT, *seen) if self.budget else seen)}
        self.shown: tuple[Tensor, Tensor, int] | None = None
        """From `pre_backward` to `post_backward`: rows of the splats that the step's cameras see, int64 [M], once
        for each camera; their opacities from there, [M] in [0, 1]; and the number of cameras."""

    def needs_absgrad(self, step: int) -> bool:
        """Whether the rasterizer must leave sum |dL/dmean2d| in `info["means2d"].absgrad` in this step."""
        return self.gradients == "absolute" and not self.rests_at(step)

    def rests_at(self, step: int) -> bool:
        """Whether it needs no gradients of this step; splats may still be replaced."""
        return False

    def begin(self, centers: Tensor, num_splats: int, pixels: int) -> None:
        """Learn what is known before the first step; warn if there are already more splats than the budget.

        Args:
            centers: centres of the training cameras, [V, 3], world units.
            num_splats: splats that the training begins with.
            pixels: number of pixels of the largest photograph.
        """
        self.pixels = pixels
        if self.verbose and 0 < self.budget < num_splats:
            fix = "With --pipeline.model.dense-start off it may begin with fewer."
            warn(f"The budget of {self.name} is {self.budget}, but the training begins with {num_splats} points. {fix}")

    def pre_backward(self, step: int, info: dict[str, Any], opacities: Tensor, logits: Tensor) -> None:
        """Look at a training view before the loss goes backward.

        For recorded steps (`training/step_graph.py`) it runs once, in the recording: every splat has a row, of radius 0
        where it is invisible, and each step refills the tensors in `info`.

        Args:
            step: training step.
            info: the rasterizer's; M rows. `change`, [M], is added if opacity is seen by its peak.
            opacities: the head's, [M] in [0, 1], before antialiasing compensation.
            logits: stored opacities of all splats, as logits [N, 1].
        """
        self.shown = (info["gaussian_ids"], opacities, info.get("n_cameras", 1))
        if self.gradients != "none" and not self.rests_at(step):
            info["means2d"].retain_grad()
        if self.opacity_seen == "peak":
            # Rows first, then the sigmoid, as heads do: in the other order the last bit may differ.
            stored = torch.sigmoid(logits.detach().index_select(0, info["gaussian_ids"])).squeeze(-1)
            changes = change_of(stored, opacities.detach().to(stored.dtype))
            # A NaN is the guard's to find; it must not stay in a statistic.
            info["change"] = torch.where(info["radii"] > 0, changes, UNSEEN).nan_to_num(UNSEEN)

    @torch.no_grad()
    def post_backward(self, step: int, info: Mapping[str, Any], splats: Splats, optimizers: Optimizers) -> None:
        """Change the table after the optimisers' step, given the `info` of `pre_backward` with gradients."""
        self.shown = None
        self.change_splats(step, info, splats, optimizers)

    @abstractmethod
    def change_splats(self, step: int, info: Mapping[str, Any], splats: Splats, optimizers: Optimizers) -> None:
        """The strategy's own part of `post_backward`, without gradients."""

    def make_tables(self, names: Iterable[str], count: int, device: torch.device) -> None:
        """Make the named statistics of splats that the state lacks yet."""
        for name in names:
            if name in self.state and self.state[name] is None:
                self.state[name] = torch.full((count,), UNSEEN if name == CHANGE else 0.0, device=device)

    def take_rows(self, rows: Tensor) -> None:
        """Let the statistics become their rows `rows`, int64 [any number], in this order."""
        self.state.update({name: value[rows] for name, value in self.state.items() if isinstance(value, Tensor)})

    def take_changes(self, info: Mapping[str, Any], count: int) -> None:
        """Let the window's changes of opacity be at least those of a step."""
        if self.opacity_seen == "peak":
            self.make_tables([CHANGE], count, info["change"].device)
            self.state[CHANGE].scatter_reduce_(0, info["gaussian_ids"], info["change"], "amax")

    def room_for(self, step: int, info: Mapping[str, Any], splats: Splats, optimizers: Optimizers, wanted: int) -> int:
        """How many of `wanted` more splats the GPU has memory for. Every refinement that may grow asks, on all devices.

        Once it is fewer, and the limit near, growth ends there, and a line says so. The limit is in checkpoints: a
        continued training has the same one, unless it is allowed another amount of memory. While the limit is not near,
        memory only slows growth, which a continued training need not repeat to the bit.
        """
        count = len(splats["means"])
        allowed = self.minimum_of_devices(memory.allowed(splats["means"].device))
        if self.state[GROWTH_LIMIT] is None or self.state[GROWTH_LIMIT][1] != allowed:
            later_pixels = max(self.pixels - info["width"] * info["height"], 0)
            room = memory.most_splats(splats, optimizers, later_pixels) - count
            most = self.minimum_of_devices(count + room // self.trainings)
            if self.minimum_of_devices(most - count - wanted) >= 0:
                return wanted
            largest_count = -self.minimum_of_devices(-count)
            if most > NEAR_LIMIT * largest_count:
                return min(wanted, most - count)
            most = max(most, largest_count)
            self.state[GROWTH_LIMIT] = most, allowed
            if self.verbose:
                held = f"growth is held at {most:,} splats a GPU, since its memory has no room for more"
                print(f"Step {step}: {held}. Smaller images or more GPUs make room (docs/troubleshooting.md).")
        return min(wanted, max(self.state[GROWTH_LIMIT][0] - count, 0))

    def planned_count(self, step: int, count: int, start: int, stop: int) -> float:
        """The number of splats that a training with a budget should have after a refinement between the steps `start`
        and `stop`: N0 + (2x - x^2) (budget - N0), with N0 at the first refinement and x in [0, 1] the share of growth
        that is over."""
        first = self.state[FIRST_COUNT] = self.state[FIRST_COUNT] or count
        x = min((step - start) / max(stop - start - self.config.refine_every, 1), 1.0)
        return first + (2 * x - x * x) * (self.budget - first)

    def minimum_of_devices(self, number: int) -> int:
        """The smallest of the devices' numbers; with one device the number itself."""
        return number

    def mean_opacity(self, logits: Tensor) -> Tensor:
        """The splats' mean opacity for the loss, a scalar: the shown one of splats that the step's cameras see, the
        stored one of all others.

        The mean of stored ones alone would reward low stored opacities to which the head adds the difference.

        Args:
            logits: stored opacities [N, 1].
        """
        if self.shown is None:
            return torch.sigmoid(logits).mean()
        rows, opacities, cameras = self.shown
        if cameras == 1 and len(rows) == len(logits):  # all are shown, or have a row
            return opacities.mean()
        stored = torch.sigmoid(logits).flatten()
        # By index_select: the gradient of an index is a sort of all rows.
        return stored.mean() + (opacities - stored.index_select(0, rows)).sum() / (cameras * len(stored))

    def regularisation(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Terms that the strategy adds to the loss, by name."""
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

    def seen_opacity(self, opacities: Tensor, before: bool = True) -> Tensor:
        """The opacities [N] that decide whether a splat is dead.

        "base": the stored ones. "peak": the stored ones with the largest change by a view since the last refinement or
        reset, and by one of the window before, if the strategy keeps it; unchanged where no view has shown the splat.
        For a head whose opacity is the stored one "peak" is "base", bit for bit.

        Args:
            opacities: logits [N, 1].
            before: count views of the window before, too.
        """
        stored = torch.sigmoid(opacities.detach().flatten())
        names = (CHANGE, CHANGE_BEFORE) if before else (CHANGE,)
        changes = [self.state[name] for name in names if self.state.get(name) is not None]
        return shown_opacity(stored, torch.stack(changes).amax(dim=0)) if changes else stored

    def begin_another_window(self) -> None:
        """Start the running maximum of changes anew; strategies with two windows keep the last as the one before."""
        if self.state.get(CHANGE) is not None:
            if CHANGE_BEFORE in self.state:
                self.state[CHANGE_BEFORE] = self.state[CHANGE]
            self.state[CHANGE] = torch.full_like(self.state[CHANGE], UNSEEN)
