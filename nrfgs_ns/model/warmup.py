# SPDX-License-Identifier: Apache-2.0
"""The warm-up: before training, the head's shared weights are taught to add nothing.

One step looks through one training camera and takes one Adam step on the mean square of the residuals of the splats
that it sees. Splats do not move: only the head's shared weights learn. A head whose output layers start at zero has
nothing to learn and is left alone.
"""

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE

LEARNING_RATE = 1e-3
"""Of Adam."""


def warm_up(model, cameras: Cameras, steps: int) -> None:
    """Teach `model.head` to be neutral, and log what that did.

    Args:
        model: an NrfgsModel in training mode.
        cameras: the training cameras, [V]; step i looks through camera i mod V.
        steps: how many steps, >= 0.
    """
    weights = list(model.head.parameters())
    if steps <= 0 or not weights:
        return
    optimizer = torch.optim.Adam(weights, lr=LEARNING_RATE, eps=1e-15)
    first = last = None
    for step in range(steps):
        index = step % len(cameras)
        found = model.far_from_neutral(cameras[index : index + 1].to(model.device), weights)
        if found is None:
            return
        visible, loss, gradients = found
        if visible == 0:
            continue
        last = loss.item() ** 0.5
        first = last if first is None else first
        if last == 0.0:  # the head adds nothing from the start
            return
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = gradient
        optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    if first is not None:
        CONSOLE.log(f"Warm-up: {steps} steps took the residuals' root mean square from {first:.2g} to {last:.2g}.")
