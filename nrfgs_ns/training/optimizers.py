# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's optimisers, with less work for the host, which bounds a training step on a GPU.

Nerfstudio keeps one Adam for each tensor, and each `Optimizer.step` costs the host more than its kernel costs the GPU.
Here Adam runs fused, and after its first step one kernel does all groups (`adam_triton.py`). State is torch's own.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from nrfgs_ns.kernels.trial import Gate
from nrfgs_ns.training.pace import Pace


class LeanOptimizers(Optimizers):
    """Nerfstudio's optimisers, stepped with few calls.

    Args:
        steps_per_log: steps between two learning rates that are logged.
        pace: position on the schedules, which each step moves on; None: the step.
    """

    def __init__(self, config, param_groups, steps_per_log: int = 10, pace: Pace | None = None):
        super().__init__(config, param_groups)
        self.steps_per_log = steps_per_log
        self.pace = pace
        self._warm: set[Optimizer] = set()
        self.fuse()

    def fuse(self) -> None:
        """Run Adam fused where its parameters are on CUDA, and unfused elsewhere, whatever a checkpoint says."""
        for optimizer in self.optimizers.values():
            if isinstance(optimizer, Adam):
                on_cuda = all(parameter.is_cuda for parameter in parameters_of(optimizer))
                for group in optimizer.param_groups:
                    group["fused"] = True if on_cuda else None
                    group["foreach"] = False if on_cuda else None
                for parameter, state in optimizer.state.items():
                    if "step" in state:
                        state["step"] = state["step"].to(parameter.device if on_cuda else "cpu")

    @property
    def all_fused(self) -> bool:
        """Whether every optimiser is a fused Adam, which can skip a step on the device (`found_inf`)."""
        return all(
            isinstance(optimizer, Adam) and all(group["fused"] for group in optimizer.param_groups)
            for optimizer in self.optimizers.values()
        )

    def zero_grad_some(self, param_groups: list[str]) -> None:
        for name in param_groups:
            for parameter in parameters_of(self.optimizers[name]):
                parameter.grad = None

    def optimizer_scaler_step_some(self, grad_scaler, param_groups: list[str]) -> None:
        lean = [name for name in param_groups if not grad_scaler.is_enabled() and self._is_lean(name)]
        super().optimizer_scaler_step_some(grad_scaler, [name for name in param_groups if name not in lean])
        fused_adam_step([self.optimizers[name] for name in lean])
        self._warm.update(self.optimizers[name] for name in param_groups)

    def _is_lean(self, name: str) -> bool:
        """Plain fused Adam that has made its first step, in which torch builds its state and checks its options."""
        optimizer = self.optimizers[name]
        with_gradient = [parameter for parameter in parameters_of(optimizer) if parameter.grad is not None]
        return (
            type(optimizer) is Adam
            and optimizer in self._warm
            and all(optimizer.state.get(parameter) for parameter in with_gradient)
            and self.config[name]["optimizer"].max_norm is None
            and all(group["fused"] and not (group["amsgrad"] or group["maximize"]) for group in optimizer.param_groups)
        )

    def scheduler_step_all(self, step: int) -> None:
        if self.pace is not None:
            self.pace.advance()
            for scheduler in self.schedulers.values():
                scheduler.last_epoch = self.pace.position - 1  # to which `step` adds 1
        for name, scheduler in self.schedulers.items():
            scheduler.step()
            if step % self.steps_per_log == 0:
                writer.put_scalar(name=f"learning_rate/{name}", scalar=scheduler.get_last_lr()[0], step=step)

    def hold(self, name: str, parameters: list[Parameter]) -> None:
        """Optimise other parameters than before under a group's name, at its learning rate and in its schedule."""
        optimizer = self.optimizers[name]
        optimizer.param_groups[0]["params"] = self.parameters[name] = parameters
        optimizer.state.clear()
        self._warm.discard(optimizer)
        self.fuse()

    def load_optimizers(self, loaded_state) -> None:
        """Load the moments; the options, learning rates among them, stay this training's."""
        own = {
            name: [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
            for name, optimizer in self.optimizers.items()
        }
        super().load_optimizers(loaded_state)
        for name, optimizer in self.optimizers.items():
            for group, options in zip(optimizer.param_groups, own[name], strict=True):
                group.update(options)
        self._warm.clear()
        self.fuse()

    def load_schedulers(self, loaded_state) -> None:
        """Load the places on the schedules; the schedules are this training's."""
        for name, state in loaded_state.items():
            scheduler = self.schedulers[name]
            scheduler.load_state_dict({**state, "base_lrs": scheduler.base_lrs})
            rates = scheduler.get_last_lr()
            if isinstance(scheduler, LambdaLR):
                pairs = zip(scheduler.base_lrs, scheduler.lr_lambdas, strict=True)
                rates = [base * share(scheduler.last_epoch) for base, share in pairs]
            for group, rate in zip(self.optimizers[name].param_groups, rates, strict=True):
                group["lr"] = rate


def fused_adam_step(optimizers: Iterable[Optimizer]) -> None:
    """One step of several fused Adams whose state exists, in one Triton kernel or, where that cannot be, by torch's
    operator; skipped where an optimiser's `found_inf` (a tensor on the device) is 1, as by torch."""
    work: list[tuple[dict[str, Any], list[Tensor], list[dict[str, Tensor]]]] = []
    skips: list[Tensor | None] = []
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if parameters:
                work.append((group, parameters, [optimizer.state[parameter] for parameter in parameters]))
                skips.append(getattr(optimizer, "found_inf", None))
    if not work:
        return
    counters = [state["step"] for _, _, states in work for state in states]
    torch._foreach_add_(counters, 1)
    with torch.no_grad():
        if _step_at_once(work, skips):
            return
        for (group, parameters, states), found_inf in zip(work, skips, strict=True):
            _step_group(group, parameters, states, found_inf)
            if found_inf is not None:
                torch._foreach_sub_([state["step"] for state in states], [found_inf] * len(states))


def _step_group(group: dict[str, Any], parameters: list[Tensor], states: list[dict], found_inf: Tensor | None) -> None:
    """One step of a group of parameters, whose counters have counted it."""
    means, squares, steps = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step"))
    options = {"lr": group["lr"], "beta1": group["betas"][0], "beta2": group["betas"][1], "eps": group["eps"]}
    options |= {"weight_decay": group["weight_decay"], "amsgrad": False, "maximize": False, "grad_scale": None}
    gradients = [parameter.grad for parameter in parameters]
    torch._fused_adam_(parameters, gradients, means, squares, [], steps, found_inf=found_inf, **options)


_GATE = Gate("Adam")
_TABLES: dict[torch.device, Any] = {}


def _step_at_once(work: list[tuple], skips: list[Tensor | None]) -> bool:
    """Make the step of all groups in one kernel, if it can be, uncounted if it is skipped."""
    device = work[0][1][0].device
    if device.type != "cuda" or any(skip is not skips[0] for skip in skips) or not try_kernel(device):
        return False
    from nrfgs_ns.training.adam_triton import AdamTable

    if device not in _TABLES:
        _TABLES[device] = AdamTable(device)
    return _TABLES[device].step(work, skips[0])


def try_kernel(device: torch.device) -> bool:
    """Whether Adam's kernel runs on a CUDA device; tried once, which compiles it: the first step would."""

    def trial() -> None:
        from nrfgs_ns.training.adam_triton import AdamTable

        number = Parameter(torch.ones(1, device=device))
        number.grad = torch.ones_like(number)
        state = {name: torch.ones(1, device=device) for name in ("exp_avg", "exp_avg_sq", "step")}
        group = {"lr": 0.1, "betas": (0.9, 0.999), "eps": 1e-15, "weight_decay": 0.0}
        with torch.no_grad():
            AdamTable(device).step([(group, [number], [state])], None)

    return _GATE.opens(device, device, trial)


def in_world_units(group: dict[str, Any], scene_unit: float) -> dict[str, Any]:
    """A parameter group's configuration for lengths, its learning rates from scene units to world units."""
    if scene_unit == 1.0:
        return group
    optimizer, scheduler = group["optimizer"], group["scheduler"]
    if scheduler is not None:
        names = [name for name in ("lr_final", "lr_pre_warmup") if getattr(scheduler, name, None) is not None]
        scheduler = replace(scheduler, **{name: getattr(scheduler, name) * scene_unit for name in names})
    return {**group, "optimizer": replace(optimizer, lr=optimizer.lr * scene_unit), "scheduler": scheduler}


def parameters_of(optimizer: Optimizer) -> list[Tensor]:
    """An optimiser's present parameters; densification replaces those that nerfstudio noted down."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
