# SPDX-License-Identifier: Apache-2.0
"""Noise on the camera centre from which the appearance head sees splats in training.

A head that stores many numbers for each splat can learn every training view by heart, and answers at random between
them. A capture whose neighbouring cameras are a distance s apart says nothing about changes over less than s. So in
training the head, and it alone, sees each splat i from a camera centre of its own,

    o_i = o + e_i,    e_i ~ N(0, sigma^2 I),    sigma = factor * s / sqrt 3,

drawn anew in each step: e_i is `factor` * s long in the root mean square. The head then learns the mean over views that
the capture cannot tell apart. To second order in sigma that is its loss plus sigma^2 / 2 times the square of its slope
by o (Bishop, Neural Computation 7, 1995), for each splat on its own: it smooths over the angle sigma / |o - x|, wide
for near splats and narrow for far ones, as are the angles between the capture's cameras.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from nrfgs_ns.data.views import distinct_places

NEIGHBOURS = 2
"""Nearest places to which distances are measured."""


def camera_spacing(centers: Tensor) -> float:
    """The distance between neighbouring training cameras with these centres [V, 3]; 0 if all stand at one place.

    It is the median, weighted by length, of the distances from each place to the two nearest other places. The short
    distances in pairs and clusters of cameras do not decide it, nor do the long ones of a few cameras far off.
    """
    places = distinct_places(centers.double())
    count = min(NEIGHBOURS, len(places) - 1)
    if count == 0:
        return 0.0
    distances = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = distances.fill_diagonal_(math.inf).topk(count, largest=False).values.flatten().sort().values
    covered = nearest.cumsum(0)
    return nearest[int((covered < 0.5 * covered[-1]).sum())].item()


class ViewNoise:
    """Noise on the means that the head sees.

    For a head that looks along o - x_i, moving the camera centre by e_i is moving the mean by -e_i. So the head is
    given other means, and one camera centre serves all splats.

    The noise depends on the seed and the step alone: a resumed training draws the same as the unbroken one.

    Args:
        length: root mean square, world units; 0 for no noise.
        seed: the training's; devices that hold different splats need different ones.
    """

    def __init__(self, length: float, seed: int):
        self.sigma, self.seed = length / math.sqrt(3.0), seed
        self._generators: dict[torch.device, torch.Generator] = {}

    def moved(self, splats: Mapping[str, Tensor], generator: torch.Generator | None) -> Mapping[str, Tensor]:
        """A table as the head sees it in a training step, with other "means" [N, 3]. None: without noise."""
        if generator is None:
            return splats
        means = splats["means"]
        noise = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
        return {**splats, "means": torch.add(means, noise, alpha=self.sigma)}

    def generator(self, device: torch.device, step: int) -> torch.Generator | None:
        """The generator of a step's noise on a device; the same object in each step. None: no noise."""
        if self.sigma == 0.0:
            return None
        if device not in self._generators:
            self._generators[device] = torch.Generator(device)
        # Two odd numbers of 64 bits, so that neighbouring steps and seeds are unrelated.
        key = (self.seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9) % 2**63
        return self._generators[device].manual_seed(key ^ key >> 31)
