# SPDX-License-Identifier: Apache-2.0
"""Fewer splats once growth has ended: those go that the training views would miss least.

Growth makes many splats that other splats could stand for. How much the pictures would change without splat i is

    s_i = sum over training views, pixels and channels of (I(p) - I_without_i(p))^2,

which is what its removal adds to the squared error, once training has brought the error's first derivative to zero
(optimal brain damage, LeCun et al. 1989; of splats: PUP 3D-GS, Hanson et al. 2025, by the derivatives of position and
size). An image is linear in the opacity that a view shows of a splat, so that s_i needs no removal
(`rasterizer.changes_without`). Opacities and colours are those that the head shows to each view.

The splats that stay make up for those that went in the steps between rounds and after the last one.
"""

import math

import torch
from torch import Tensor

from nrfgs_ns.densification.strategy import TrainingViews

ROUNDS = (1.0, 1.1, 1.2, 1.3, 1.4, 1.5)
"""When splats go, in multiples of the step at which growth ends; at each as large a share of those that are left."""
DRAWS = 240
"""Times that signs are drawn for all views together, at least, and at least once for each."""


def missed(views: TrainingViews, count: int, device: torch.device) -> Tensor:
    """s_i of all splats, [N]; 0 for what no training view shows."""
    total = torch.zeros(count, device=device)
    generator = torch.Generator(device).manual_seed(torch.initial_seed())
    passes = math.ceil(DRAWS / max(len(views), 1))
    for index in range(len(views)):
        rows, changes = views.changes_without(index, generator, passes)
        total.index_add_(0, rows, changes)
    return total


def least_missed(score: Tensor, keep: float) -> Tensor:
    """Which splats go in one round, bool [N], so that after all rounds the share `keep` is left."""
    stay = max(round(len(score) * keep ** (1 / len(ROUNDS))), 1)
    gone = torch.ones(len(score), dtype=torch.bool, device=score.device)
    gone[score.topk(stay).indices] = False
    return gone
