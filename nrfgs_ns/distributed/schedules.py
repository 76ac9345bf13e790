# SPDX-License-Identifier: Apache-2.0
"""Step numbers and learning rates of one device, for W images a step.

Splatfacto's schedules are written for one image a step. With `--pipeline.sharding.schedules images` a training on W
devices sees as many images as on one, in 1 / W of the steps: everything that counts steps counts W times as fast.

The mean of W gradients has sqrt(W) times less noise, and Adam divides by the gradient's size: its steps are multiplied
by sqrt(W), and its averages forget W times as fast, so that they still cover as many images,

    lr' = sqrt(W) lr,    beta' = 1 - W (1 - beta),    eps' = eps / sqrt(W)

(the square-root rule, Malladi et al. 2022, as in gsplat's own batches).
"""

import math
from dataclasses import replace
from typing import Any

from torch.optim import Optimizer


def fewer(steps: int | None, devices: int) -> int | None:
    """A step number, divided; never 0 unless it was. None stays None."""
    return max(1, round(steps / devices)) if steps is not None and steps > 0 else steps


def with_fewer_steps(config: Any, devices: int) -> Any:
    """A trainer's configuration for W devices that see as many images as one device would.

    Args:
        config: an NrfgsTrainerConfig, for one device; stays what it is.
    """

    def divided(part: Any, names: tuple[str, ...]) -> Any:
        return replace(part, **{name: fewer(getattr(part, name), devices) for name in names})

    model = config.pipeline.model
    model = replace(
        divided(model, ("resolution_schedule", "sh_degree_interval")),
        appearance=divided(model.appearance, model.appearance.STEPS),
        densification=divided(model.densification, model.densification.steps),  # resets are counted in refinements
    )
    names = (
        "max_num_iterations",
        "average_steps",
        "steps_per_save",
        "steps_per_eval_image",
        "steps_per_eval_all_images",
    )
    return replace(
        config,
        pipeline=replace(config.pipeline, model=model),
        optimizers={name: _scaled(group, devices) for name, group in config.optimizers.items()},
        **{name: fewer(getattr(config, name), devices) for name in names},
    )


def _scaled(group: dict[str, Any], devices: int) -> dict[str, Any]:
    """An optimiser's and its scheduler's configuration with the larger steps, and fewer of them."""
    root = math.sqrt(devices)
    optimizer = group["optimizer"]
    result = {**group, "optimizer": replace(optimizer, lr=optimizer.lr * root, eps=optimizer.eps / root)}
    scheduler = group.get("scheduler")
    if scheduler is not None:
        changes: dict[str, Any] = {"max_steps": fewer(scheduler.max_steps, devices)}
        if hasattr(scheduler, "warmup_steps"):
            changes["warmup_steps"] = fewer(scheduler.warmup_steps, devices)
        if getattr(scheduler, "lr_final", None) is not None:
            changes["lr_final"] = scheduler.lr_final * root
        if hasattr(scheduler, "lr_pre_warmup"):
            changes["lr_pre_warmup"] = scheduler.lr_pre_warmup * root
        result["scheduler"] = replace(scheduler, **changes)
    return result


def forget_faster(optimizers: dict[str, Optimizer], devices: int) -> None:
    """Give Adam's averages the shorter memory."""
    for optimizer in optimizers.values():
        for group in optimizer.param_groups:
            if "betas" in group:
                group["betas"] = tuple(max(0.0, 1.0 - devices * (1.0 - beta)) for beta in group["betas"])
