# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's optimisers, with less work for the host.

A training step on a GPU is bound by what Python does between kernels. Nerfstudio keeps one Adam for each tensor, and
each `Optimizer.step` costs the host more than its kernel costs the GPU. Here Adam runs fused, one kernel for each
group, and after its first step that kernel is called directly. Numbers and state are torch's own, so densification
and checkpoints find what they expect.
"""

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from nrfgs_ns.training.pace import Pace


class LeanOptimizers(Optimizers):
    """Nerfstudio's optimisers, stepped with few calls.

    Args:
        config: optimiser configurations by group, as nerfstudio passes them.
        param_groups: parameters by group.
        steps_per_log: steps between two learning rates that are logged.
        pace: moved on by each step, and where the schedules are looked up; None: a step is a step.
    """

    def __init__(self, config, param_groups, steps_per_log: int = 10, pace: Pace | None = None):
        super().__init__(config, param_groups)
        # That is so of a head that rests at first (`head_from`).
        warnings.filterwarnings("ignore", message=r"Detected call of `lr_scheduler\.step\(\)` before `optimizer\.step")
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
        super().load_optimizers(loaded_state)
        self._warm.clear()
        self.fuse()


def fused_adam_step(optimizers: Iterable[Optimizer]) -> None:
    """One step of several fused Adams whose state exists; the operator is that of `Adam(fused=True).step`.

    An optimiser's `found_inf` (a tensor on the device, 1.0 for "skip this step") is heeded as torch heeds it.
    """
    counters: list[Tensor] = []
    skips: list[Tensor] = []
    work = []
    for optimizer in optimizers:
        found_inf = getattr(optimizer, "found_inf", None)
        for group in optimizer.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if not parameters:
                continue
            states = [optimizer.state[parameter] for parameter in parameters]
            steps = [state["step"] for state in states]
            counters += steps
            skips += [found_inf] * len(steps) if found_inf is not None else []
            work.append((group, parameters, states, steps, found_inf))
    if not work:
        return
    torch._foreach_add_(counters, 1)
    with torch.no_grad():
        for group, parameters, states, steps, found_inf in work:
            beta1, beta2 = group["betas"]
            torch._fused_adam_(
                parameters,
                [parameter.grad for parameter in parameters],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                steps,
                lr=group["lr"],
                beta1=beta1,
                beta2=beta2,
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                amsgrad=False,
                maximize=False,
                grad_scale=None,
                found_inf=found_inf,
            )
    if skips:
        torch._foreach_sub_(counters, skips)


def in_world_units(group: dict[str, Any], scene_unit: float) -> dict[str, Any]:
    """A parameter group's configuration for lengths, its learning rates from scene units to world units.

    Args:
        group: nerfstudio's "optimizer" and "scheduler".
        scene_unit: world units in a scene unit.
    """
    if scene_unit == 1.0:
        return group
    optimizer, scheduler = group["optimizer"], group["scheduler"]
    if scheduler is not None:
        names = [name for name in ("lr_final", "lr_pre_warmup") if getattr(scheduler, name, None) is not None]
        scheduler = replace(scheduler, **{name: getattr(scheduler, name) * scene_unit for name in names})
    return {**group, "optimizer": replace(optimizer, lr=optimizer.lr * scene_unit), "scheduler": scheduler}


def parameters_of(optimizer: Optimizer) -> list[Tensor]:
    """What an optimiser holds now; densification replaces the tensors that nerfstudio noted down."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
