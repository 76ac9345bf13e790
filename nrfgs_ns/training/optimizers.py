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
        self._table: Any = None
        """the kernel's `AdamTable`, not shared with a twin's, since the host waits for the copy of the last step's"""
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
        stepped = plain if self.step_at_once(plain) else []
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

    def step_at_once(self, optimizers: Sequence[Adam]) -> bool:
        """Make one step of fused Adams that have state by one Triton kernel, if it runs; returns whether it did. As in
        torch, the step changes nothing where `found_inf`, a tensor that they share, is 1."""
        work = [
            (group, parameter, optimizer.state[parameter])
            for optimizer in optimizers
            for group in optimizer.param_groups
            for parameter in group["params"]
            if parameter.grad is not None
        ]
        if not work or (device := work[0][1].device).type != "cuda" or not try_kernel(device):
            return False
        from nrfgs_ns.training.adam_triton import AdamTable

        self._table = self._table or AdamTable(device)
        counters = [state["step"] for _, _, state in work]
        with torch.no_grad():
            torch._foreach_add_(counters, 1)
            done = self._table.step(work, getattr(optimizers[0], "found_inf", None))
            if not done:
                torch._foreach_sub_(counters, 1)
        return done

    def scheduler_step_all(self, step: int) -> None:
        if self.pace is not None:
            self.pace.advance()
            for scheduler in self.schedulers.values():
                scheduler.last_epoch = self.pace.position - 1  # to which `step` adds 1
        for name, scheduler in self.schedulers.items():
            scheduler.step()
            if step % self.steps_per_log == 0:
                writer.put_scalar(name=f"learning_rate/{name}", scalar=scheduler.get_last_lr()[0], step=step)

    def load_optimizers(self, loaded_state, weights: Sequence[Parameter] = ()) -> None:
        """Load the moments; options such as learning rates, or whether Adam is fused, stay this training's. `weights`
        are the head's, which is another one than was built if the checkpoint's is smaller."""
        if weights:
            self.optimizers["field"].param_groups[0]["params"] = self.parameters["field"] = list(weights)
        for name, state in loaded_state.items():
            optimizer = self.optimizers[name]
            optimizer.load_state_dict({**state, "param_groups": optimizer.state_dict()["param_groups"]})

    def load_schedulers(self, loaded_state) -> None:
        """Load the positions on the schedules, which stay this training's."""
        for name, state in loaded_state.items():
            scheduler = self.schedulers[name]
            scheduler.load_state_dict({**state, "base_lrs": scheduler.base_lrs})
            (group,), (factor,) = self.optimizers[name].param_groups, scheduler.lr_lambdas
            group["lr"] = scheduler.base_lrs[0] * factor(scheduler.last_epoch)


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
