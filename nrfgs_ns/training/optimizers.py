# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's optimisers with less work for the host, which bounds a training step on a GPU.

Nerfstudio keeps one Adam for each tensor, and each `Optimizer.step` costs the host more than its kernel costs the GPU.
Here Adam runs fused, and after its first step one kernel steps all groups (`adam_triton.py`), if Triton runs. State is
torch's own.
"""

from collections.abc import Sequence
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from nrfgs_ns.kernels.trial import tried_once
from nrfgs_ns.training.pace import Pace


class LeanOptimizers(Optimizers):
    """Nerfstudio's optimisers, stepped with few calls.

    Args:
        steps_per_log: steps between two logged learning rates.
        pace: position on the schedules, advanced by each step; None: the step.
    """

    def __init__(self, config, param_groups, steps_per_log: int = 10, pace: Pace | None = None):
        super().__init__(config, param_groups)
        self.steps_per_log = steps_per_log
        self.pace = pace
        self._tables: dict[torch.device, Any] = {}
        """not shared with a twin's, since the host waits for the copy of the last step's"""
        for optimizer in self.optimizers.values():
            if isinstance(optimizer, Adam) and all(parameter.is_cuda for parameter in parameters_of(optimizer)):
                for group in optimizer.param_groups:
                    group["fused"], group["foreach"] = True, False

    @property
    def all_fused(self) -> bool:
        """Whether every optimiser is a fused Adam, which can skip a step on the device (`found_inf`)."""
        return all(map(is_fused, self.optimizers.values()))

    def zero_grad_all(self) -> None:
        for optimizer in self.optimizers.values():
            for parameter in parameters_of(optimizer):
                parameter.grad = None

    def step(self) -> None:
        """One step of all optimisers."""
        plain = [optimizer for name, optimizer in self.optimizers.items() if self._is_plain(name)]
        stepped = plain if step_at_once(plain, self._tables) else []
        for name, optimizer in self.optimizers.items():
            if optimizer not in stepped:
                if (max_norm := self.config[name]["optimizer"].max_norm) is not None:
                    torch.nn.utils.clip_grad_norm_(parameters_of(optimizer), max_norm)
                optimizer.step()

    def _is_plain(self, name: str) -> bool:
        """Whether an optimiser is fused Adam without clipping that has state, which torch builds in its first step."""
        optimizer = self.optimizers[name]
        return (
            type(optimizer) is Adam
            and is_fused(optimizer)
            and self.config[name]["optimizer"].max_norm is None
            and all(optimizer.state.get(p) for p in parameters_of(optimizer) if p.grad is not None)
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

    def replace_parameters(self, name: str, parameters: list[Parameter]) -> None:
        """Replace a group's parameters, at its learning rate and schedule."""
        optimizer = self.optimizers[name]
        optimizer.param_groups[0]["params"] = self.parameters[name] = parameters
        optimizer.state.clear()

    def load_optimizers(self, loaded_state) -> None:
        """Load the moments; options such as learning rates, or whether Adam is fused, stay this training's."""
        for name, state in loaded_state.items():
            optimizer = self.optimizers[name]
            optimizer.load_state_dict({**state, "param_groups": optimizer.state_dict()["param_groups"]})

    def load_schedulers(self, loaded_state) -> None:
        """Load the positions on the schedules, which stay this training's."""
        for name, state in loaded_state.items():
            scheduler = self.schedulers[name]
            scheduler.load_state_dict({**state, "base_lrs": scheduler.base_lrs})
            parts = self.optimizers[name].param_groups, scheduler.base_lrs, scheduler.lr_lambdas
            for group, base, factor in zip(*parts, strict=True):
                group["lr"] = base * factor(scheduler.last_epoch)


def step_at_once(optimizers: Sequence[Adam], tables: dict[torch.device, Any]) -> bool:
    """Make one step of several fused Adams that have state by one Triton kernel, if it runs; returns whether it did. As
    in torch, the step changes nothing where the optimisers' `found_inf`, a tensor on the device, is 1. `tables` keeps
    the device's `AdamTable`."""
    work = [
        (group, parameter, optimizer.state[parameter])
        for optimizer in optimizers
        for group in optimizer.param_groups
        for parameter in group["params"]
        if parameter.grad is not None
    ]
    device = work[0][1].device if work else torch.device("cpu")
    skips = [getattr(optimizer, "found_inf", None) for optimizer in optimizers]
    if device.type != "cuda" or any(skip is not skips[0] for skip in skips) or not try_kernel(device):
        return False
    from nrfgs_ns.training.adam_triton import AdamTable

    counters = [state["step"] for _, _, state in work]
    with torch.no_grad():
        torch._foreach_add_(counters, 1)
        if device not in tables:
            tables[device] = AdamTable(device)
        done = tables[device].step(work, skips[0])
        if not done:
            torch._foreach_sub_(counters, 1)
    return done


@tried_once("Adam")
def try_kernel(device: torch.device) -> bool:
    """Whether Adam's kernel runs on a CUDA device; compiles it before the first step."""
    from nrfgs_ns.training.adam_triton import AdamTable

    number = Parameter(torch.ones(1, device=device))
    number.grad = torch.ones_like(number)
    state = {name: torch.ones(1, device=device) for name in ("exp_avg", "exp_avg_sq", "step")}
    group = {"lr": 0.1, "betas": (0.9, 0.999), "eps": 1e-15, "weight_decay": 0.0}
    with torch.no_grad():
        AdamTable(device).step([(group, number, state)], None)
    return True


def is_fused(optimizer: Optimizer) -> bool:
    return isinstance(optimizer, Adam) and all(group["fused"] for group in optimizer.param_groups)


def parameters_of(optimizer: Optimizer) -> list[Tensor]:
    """An optimiser's present parameters; densification replaces those that nerfstudio noted down."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
