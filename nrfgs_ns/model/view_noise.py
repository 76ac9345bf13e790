# SPDX-License-Identifier: Apache-2.0
"""What a capture cannot tell apart, the appearance head must not either: noise on where it is asked from.

A head that stores many numbers for each splat can learn every training view by heart, and answers at random between
them. A capture whose neighbouring cameras are a distance s apart says nothing of changes over less than s. So in
training each splat i is seen, by the head alone, from a camera centre of its own,

    o_i = o + e_i,    e_i ~ N(0, sigma^2 I),    sigma = factor * s / sqrt 3,

drawn anew in each step: e_i is `factor` * s long in the root mean square. What the head learns is then the mean over
views that the capture cannot tell apart. To second order in sigma that is its loss plus sigma^2 / 2 times the square
of its slope by o (Bishop, Neural Computation 7, 1995), for each splat on its own: the angle that it smooths over is
sigma / |o - x|, wide for near splats and narrow for far ones, as the angles between the capture's cameras are.
Rendering, geometry and evaluation are as without it.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from nrfgs_ns.data.views import distinct_places

NEIGHBOURS = 2
"""Nearest places that a place's spacing is measured to."""


def camera_spacing(centers: Tensor) -> float:
    """The distance between neighbouring training cameras, in the units of `centers`.

    Of the distances from each place of the capture to its two nearest other places, the median in which a distance
    counts by its length. So the short distances of cameras that stand at one place or in pairs do not decide, nor do
    the long ones of a few that stand far off.

    Args:
        centers: of the cameras, [V, 3].

    Returns:
        The spacing; 0 if all cameras stand at one place.
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
    """Moves what the head sees.

    To move the camera's centre by e_i for splat i is, for a head that looks along o - x_i, to move the mean by -e_i; so
    the head is given other means, one camera centre serves all splats, and its fast paths stay open. Gradients by the
    means are those without noise, taken at another place.

    The noise of a step depends on the seed and the step alone: a training that goes on from a checkpoint draws what the
    unbroken one does, and other generators stay where they are.

    Args:
        sigma: of each coordinate, world units; 0 for no noise.
        seed: of the training; devices that hold different splats need different ones.
    """

    def __init__(self, sigma: float, seed: int):
        self.sigma, self.seed = sigma, seed
        self._generators: dict[torch.device, torch.Generator] = {}

    @classmethod
    def as_long_as(cls, length: float, seed: int) -> "ViewNoise":
        """Noise of this length in the root mean square, in world units."""
        return cls(length / math.sqrt(3.0), seed)

    def moved(self, splats: Mapping[str, Tensor], step: int) -> Mapping[str, Tensor]:
        """The table as the head is to see it in a step: its "means" [N, 3] moved, all else the same tensors.

        Args:
            splats: the table; itself is returned if there is no noise.
            step: training step.
        """
        return self.moved_by(splats, None if self.sigma == 0.0 else self.generator(splats["means"].device, step))

    def moved_by(self, splats: Mapping[str, Tensor], generator: torch.Generator | None) -> Mapping[str, Tensor]:
        """The same with the numbers of a generator; None: without noise."""
        if generator is None:
            return splats
        means = splats["means"]
        noise = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
        return {**splats, "means": torch.add(means, noise, alpha=self.sigma)}

    def generator(self, device: torch.device, step: int) -> torch.Generator:
        """The generator of a step's noise on a device: the same object in each step."""
        if device not in self._generators:
            self._generators[device] = torch.Generator(device)
        # Two odd numbers of 64 bits, so that neighbouring steps and seeds have nothing to do with each other.
        key = (self.seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9) % 2**63
        return self._generators[device].manual_seed(key ^ key >> 31)
