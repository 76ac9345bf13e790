# SPDX-License-Identifier: Apache-2.0
"""The warm-up: before training, the head's shared weights are taught to add nothing.

One step looks through one training camera and takes one Adam step on the mean square of the visible splats' residuals.
Only the head's shared weights learn. A head whose output layers start at zero has nothing to learn and is left alone.
"""

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE

LEARNING_RATE = 1e-3


def warm_up(model, cameras: Cameras, steps: int) -> None:
    """Teach `model.head` to be neutral, and log the result.

    Args:
        model: an NrfgsModel in training mode.
        cameras: the training cameras, [V]; step i looks through camera i mod V.
        steps: number of steps, >= 0.
    """
    weights = list(model.head.parameters())
    if not weights:
        return
    optimizer = torch.optim.Adam(weights, lr=LEARNING_RATE, eps=1e-15)
    residuals = []  # root mean square in each step
    for step in range(steps):
        index = step % len(cameras)
        neutral = model.far_from_neutral(cameras[index : index + 1].to(model.device), weights)
        if neutral is None:
            return
        visible, loss, gradients = neutral
        if visible == 0:
            continue
        residuals.append(loss.item() ** 0.5)
        if residuals[-1] == 0.0:  # the head adds nothing from the start
            return
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = gradient
        optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    if residuals:
        change = f"from {residuals[0]:.2g} to {residuals[-1]:.2g}"
        CONSOLE.log(f"Warm-up: {steps} steps took the residuals' root mean square {change}.")
