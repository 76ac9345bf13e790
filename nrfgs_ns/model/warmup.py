# SPDX-License-Identifier: Apache-2.0
"""The warm-up: before training, the head's shared weights are taught to add nothing.

One step looks through one training camera and takes one Adam step on the mean square of the visible splats' residuals.
Only the head's shared weights learn. A head whose output layers start at zero has nothing to learn and is left alone.
"""

import torch
from nerfstudio.cameras.cameras import Cameras

from nrfgs_ns.errors import InputError

LEARNING_RATE = 1e-3


def warm_up(model, cameras: Cameras, steps: int) -> None:
    """Teach `model.head` to be neutral.

    Args:
        model: an NrfgsModel in training mode.
        cameras: the training cameras, [V]; step i looks through camera i mod V.
        steps: number of steps, >= 0.

    Raises:
        InputError: there is something to learn, and the model has one of several devices' splats alone.
    """
    weights = list(model.head.parameters())
    if not weights:
        return
    optimizer = torch.optim.Adam(weights, lr=LEARNING_RATE, eps=1e-15)
    for step in range(steps):
        index = step % len(cameras)
        with torch.no_grad():
            view = model.project(cameras[index : index + 1].to(model.device))
        loss = model.head.neutral_loss(model.field.splats, view.visible, view.center)
        if loss is None or loss.item() == 0.0:  # the head adds nothing from the start
            return
        if len(view.visible) == 0:
            continue
        if not model.warms_up:
            fix = "Use one, or --pipeline.model.warmup-steps 0."
            raise InputError(f"The head starts with a residual, and is warmed up on one device only. {fix}")
        loss.backward(inputs=weights)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
