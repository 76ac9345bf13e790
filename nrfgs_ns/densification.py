# SPDX-License-Identifier: Apache-2.0
"""How splats come and go during training: one class per protocol behind one small interface.

- `splatfacto`: nerfstudio's rules and thresholds, all of them options of the model.
- `original`: 3DGS (Kerbl et al. 2023): mean screen-space gradients above 2e-4 grow, opacities below 0.005 go, sizes are
  measured against the extent of the cameras.
- `mcmc`: 3DGS-MCMC (Kheradmand et al. 2024): nothing is deleted. Dead splats move to live ones, noise explores, and
  the count grows to a budget and stays there.

The splats are a table, name -> parameter [N, ...]. Whatever a protocol does to the rows, it does to every tensor of the
table, whoever's head it belongs to, and to the optimisers' moments. The model never asks which protocol it has.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from nrfgs_ns.appearance.diffuse import DIFFUSE, SHIFT
from nrfgs_ns.errors import InputError
from nrfgs_ns.relocation import add_samples, diffuse, relocate

Protocol = Literal["splatfacto", "original", "mcmc"]
OpacitySeen = Literal["base", "peak"]

UNSEEN = -1.0
"""Peak opacity of a splat that no view has shown since then."""
EXTENT_MARGIN = 1.1
"""3DGS's extent of a scene: the largest distance of a training camera from their mean, times this."""
LARGEST_BUDGET = 2**24
"""`torch.multinomial` draws from no more categories than this."""
STRATEGY_BOUNDS = ("refine_start_iter", "refine_stop_iter", "refine_scale2d_stop_iter")
"""What begins or ends by step number in gsplat's strategy."""
SPLATFACTOS_THRESHOLDS = (
    "cull_alpha_thresh",
    "densify_grad_thresh",
    "densify_size_thresh",
    "cull_scale_thresh",
    "use_absgrad",
    "cull_screen_size",
    "split_screen_size",
    "stop_screen_size_at",
)
"""Options of the model that only the protocol `splatfacto` reads."""


@dataclass
class OriginalDensification:
    """Thresholds of 3DGS. Its schedule is in the model's warmup_length, refine_every, reset_alpha_every and
    stop_split_at, whose defaults are those of 3DGS."""

    grow_gradient: float = 2e-4
    """splats whose mean gradient of the loss by the screen position (normalised to [-1, 1]) is larger grow"""
    grow_scale: float = 0.01
    """growing splats up to this size are duplicated, larger ones are split; in extents of the cameras"""
    prune_opacity: float = 0.005
    """splats of lower opacity go; a reset brings opacities down to twice this"""
    prune_scale: float = 0.1
    """larger splats go, once opacities have been reset; in extents of the cameras"""


@dataclass
class McmcDensification:
    """Constants of 3DGS-MCMC, as in gsplat. Its start and rhythm are the model's warmup_length and refine_every; it
    starts from the same splats as the other protocols."""

    min_opacity: float = 0.005
    """splats of this opacity or less are dead and move"""
    stop_at: int = 25_000
    """step after which splats neither move to others nor are added"""
    noise_lr: float = 5e5
    """size of the noise on positions, times the current learning rate of the means"""
    opacity_regularisation: float = 0.01
    """weight of the mean opacity in the loss"""
    scale_regularisation: float = 0.01
    """weight of the mean standard deviation, in scene units, in the loss"""


class Shown(NamedTuple):
    """What the views of a step have shown."""

    rows: Tensor
    """splats, int64 [M]; one that several cameras see is there several times"""
    opacities: Tensor
    """theirs, from there, [M] in [0, 1]"""
    cameras: int
    """number of cameras"""


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


class PruneBySeenOpacity(DefaultStrategy):
    """gsplat's strategy with another idea of which opacity counts when splats are pruned."""

    seen_opacity: Any = None
    """Logits [N, 1] -> opacities [N]; None: the stored ones, as in gsplat."""

    @torch.no_grad()
    def _prune_gs(self, params, optimizers, state, step) -> int:
        if self.seen_opacity is None:
            return super()._prune_gs(params, optimizers, state, step)
        prune = self.seen_opacity(params["opacities"]) < self.prune_opa
        if step > self.reset_every:
            prune |= params["scales"].exp().amax(dim=-1) > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                prune |= state["radii"] > self.prune_scale2d
        count = int(prune.sum())
        if count > 0:
            remove(params, optimizers, state, prune)
        return count


class GradientDensification(Densification):
    """Growth where screen-space gradients are large, pruning and resetting of opacities: splatfacto's, and 3DGS's.

    Args:
        name: of the protocol.
        strategy: gsplat's, with the protocol's thresholds.
        opacity_seen: which opacity pruning looks at. A reset always acts on the stored one.
        scene_unit: world units in a scene unit, which sizes are measured in; None: in extents of the cameras.
        reset_at_start: reset opacities at step 0, too, as gsplat 1.4 does; 3DGS counts its steps from 1.
    """

    def __init__(
        self,
        name: Protocol,
        strategy: PruneBySeenOpacity,
        opacity_seen: OpacitySeen,
        scene_unit: float | None,
        reset_at_start: bool,
    ):
        super().__init__(opacity_seen)
        self.name = name
        self.strategy = strategy
        self.bounds = {name: getattr(strategy, name) for name in STRATEGY_BOUNDS}
        self.absgrad = strategy.absgrad
        self.measure_by_cameras = scene_unit is None
        self.reset_at_start = reset_at_start
        self.state |= strategy.initialize_state(scene_scale=scene_unit or 1.0)
        if opacity_seen == "peak":
            strategy.seen_opacity = self.seen_opacity

    def see_cameras(self, centers: Tensor) -> None:
        if self.measure_by_cameras:
            spread = (centers - centers.mean(dim=0)).norm(dim=-1).max().item()
            self.state["scene_scale"] = EXTENT_MARGIN * spread or 1.0  # one camera has no extent

    def pre_backward(self, step: int, info: Mapping[str, Any], opacities: Tensor, count: int) -> None:
        if step < self.strategy.refine_stop_iter:
            super().pre_backward(step, info, opacities, count)
        info["means2d"].retain_grad()

    def post_backward(self, step, info, splats, optimizers) -> None:
        strategy = self.strategy
        if step == 0 and not self.reset_at_start:
            strategy._update_state(splats, self.state, info, packed=True)
            return
        strategy.step_post_backward(splats, optimizers, self.state, step, info, packed=True)
        if step % strategy.reset_every == 0 or self._refines(step):
            self.forget_peak()

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        for name, step in self.bounds.items():
            setattr(self.strategy, name, step_at(step) if step > 0 else step)

    def _refines(self, step: int) -> bool:
        """Whether gsplat's strategy grows and prunes at this step."""
        strategy = self.strategy
        return (
            strategy.refine_start_iter < step < strategy.refine_stop_iter
            and step % strategy.refine_every == 0
            and step % strategy.reset_every >= strategy.pause_refine_after_reset
        )


class Mcmc(Densification):
    """Relocation, growth to a budget, and noise (`relocation.py`).

    Args:
        config: the constants.
        budget: most splats.
        start, every: first step of, and steps between, relocations.
        opacity_seen: which opacity decides that a splat is dead and how far noise may move it. What a relocated splat
            gets is computed from the stored opacities.
        scene_unit: world units in a scene unit.

    The mean opacity in the loss is that of what the step's cameras are shown, with the stored opacities of all else. If
    it were that of the stored ones alone, a head that adds to them would be paid for making them small: splats that
    every view shows would count as dead, and the noise, made for splats that nobody sees, would shake them.
    """

    name = "mcmc"

    def __init__(
        self,
        config: McmcDensification,
        budget: int,
        start: int,
        every: int,
        opacity_seen: OpacitySeen,
        scene_unit: float = 1.0,
    ):
        super().__init__(opacity_seen)
        if opacity_seen == "peak":
            self.state["peak_before"] = None  # between the two last relocations
        self.shown: Shown | None = None
        self.scene_unit = scene_unit
        self.config, self.budget, self.start, self.every = config, budget, start, every
        self.stop, self.bounds = config.stop_at, (start, config.stop_at)

    def pre_backward(self, step: int, info: Mapping[str, Any], opacities: Tensor, count: int) -> None:
        super().pre_backward(step, info, opacities, count)
        self.shown = Shown(info["gaussian_ids"], opacities, info.get("n_cameras", 1))

    @torch.no_grad()
    def post_backward(self, step, info, splats, optimizers) -> None:
        config, self.shown = self.config, None
        if self.start < step < self.stop and step % self.every == 0:
            dead = self.seen_opacity(splats["opacities"]) <= config.min_opacity
            moved = relocate(splats, optimizers, dead, config.min_opacity)
            count = len(splats["means"])
            added = add_samples(
                splats, optimizers, max(0, min(self.budget, int(1.05 * count)) - count), config.min_opacity
            )
            self._begin_another_peak(moved[added])
        lr = float(optimizers["means"].param_groups[0]["lr"])
        size = config.noise_lr * lr / self.scene_unit**2  # times a covariance; lr is a length already
        diffuse(splats, size, self._lately_seen(splats["opacities"]))

    def _lately_seen(self, opacities: Tensor) -> Tensor:
        """As `seen_opacity`, over the views since the relocation before the last: the noise, which is there in every
        step, must not take a splat for invisible because no view has come by yet."""
        base = torch.sigmoid(opacities.detach().flatten())
        peaks = [self.state[name] for name in ("peak", "peak_before") if self.state.get(name) is not None]
        if not peaks:
            return base
        peak = torch.stack(peaks).amax(dim=0)
        return torch.where(peak > UNSEEN, peak, base)

    def _begin_another_peak(self, source: Tensor) -> None:
        """Keep what has been seen until now, each row that of the splat that it was made from, int64 [N']."""
        if self.state.get("peak") is not None:
            self.state["peak_before"] = self.state["peak"][source]
            self.state["peak"] = None  # the rows have changed

    def reschedule(self, step_at: Callable[[float], int]) -> None:
        self.start, self.stop = (step_at(step) for step in self.bounds)

    def regularisation(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        base = torch.sigmoid(splats["opacities"]).flatten()
        mean = base.mean()
        if self.shown is not None:
            rows, opacities, cameras = self.shown
            mean = mean + (opacities - base[rows]).sum() / (cameras * len(base))
        return {
            "mcmc_opacity_reg": self.config.opacity_regularisation * mean,
            "mcmc_scale_reg": self.config.scale_regularisation * splats["scales"].exp().mean() / self.scene_unit,
        }


def build_densification(config: Any, num_train_images: int, scene_unit: float = 1.0) -> Densification:
    """The protocol that a model's configuration asks for.

    Args:
        config: an NrfgsModelConfig.
        num_train_images: splatfacto waits for as many steps after a reset.
        scene_unit: world units in a scene unit, in which the configuration's sizes are.

    Raises:
        InputError: an option is out of range, or belongs to another protocol.
    """
    makers = {"splatfacto": _splatfacto, "original": _original, "mcmc": _mcmc}
    if config.densification not in makers:
        raise InputError(
            f"pipeline.model.densification is {config.densification!r}; use one of {', '.join(map(repr, makers))}."
        )
    if config.opacity_seen_by_densification not in (None, "base", "peak"):
        raise InputError(
            f"pipeline.model.opacity_seen_by_densification is {config.opacity_seen_by_densification!r}; "
            "use 'base' or 'peak'."
        )
    return makers[config.densification](config, num_train_images, scene_unit)


def _splatfacto(config: Any, num_train_images: int, scene_unit: float) -> Densification:
    strategy = PruneBySeenOpacity(
        prune_opa=config.cull_alpha_thresh,
        grow_grad2d=config.densify_grad_thresh,
        grow_scale3d=config.densify_size_thresh,
        grow_scale2d=config.split_screen_size,
        prune_scale3d=config.cull_scale_thresh,
        prune_scale2d=config.cull_screen_size,
        refine_scale2d_stop_iter=config.stop_screen_size_at,
        refine_start_iter=config.warmup_length,
        refine_stop_iter=config.stop_split_at,
        reset_every=config.reset_alpha_every * config.refine_every,
        refine_every=config.refine_every,
        pause_refine_after_reset=num_train_images + config.refine_every,
        absgrad=config.use_absgrad,
        revised_opacity=False,
        verbose=True,
    )
    return GradientDensification(
        "splatfacto", strategy, config.opacity_seen_by_densification or "base", scene_unit, reset_at_start=True
    )


def _original(config: Any, num_train_images: int, scene_unit: float) -> Densification:
    _refuse_options(config, SPLATFACTOS_THRESHOLDS)
    rules: OriginalDensification = config.original
    strategy = PruneBySeenOpacity(
        prune_opa=rules.prune_opacity,
        grow_grad2d=rules.grow_gradient,
        grow_scale3d=rules.grow_scale,
        prune_scale3d=rules.prune_scale,
        refine_scale2d_stop_iter=0,
        refine_start_iter=config.warmup_length,
        refine_stop_iter=config.stop_split_at,
        reset_every=config.reset_alpha_every * config.refine_every,
        refine_every=config.refine_every,
        pause_refine_after_reset=0,
        absgrad=False,
        verbose=True,
    )
    return GradientDensification(
        "original", strategy, config.opacity_seen_by_densification or "base", scene_unit=None, reset_at_start=False
    )


def _mcmc(config: Any, num_train_images: int, scene_unit: float) -> Densification:
    _refuse_options(config, (*SPLATFACTOS_THRESHOLDS, "reset_alpha_every", "stop_split_at"))
    if not 1 <= config.splat_budget <= LARGEST_BUDGET:
        raise InputError(
            f"pipeline.model.splat_budget is {config.splat_budget}; it must lie between 1 and {LARGEST_BUDGET}."
        )
    return Mcmc(
        config.mcmc,
        budget=config.splat_budget,
        start=config.warmup_length,
        every=config.refine_every,
        opacity_seen=config.opacity_seen_by_densification or "peak",
        scene_unit=scene_unit,
    )


def _refuse_options(config: Any, names: tuple[str, ...]) -> None:
    """Raise InputError where an option was set that this protocol does not read: it would be ignored silently."""
    for name in names:
        if getattr(config, name) != getattr(type(config), name):
            protocol = config.densification
            raise InputError(
                f"pipeline.model.{name} has no effect with the densification {protocol!r}. Leave it out, or use "
                f"--pipeline.model.{protocol}.... (see ns-train METHOD --help)."
            )
