# SPDX-License-Identifier: Apache-2.0
"""A network for each pixel, after Neural Harmonic Textures (Condor et al., arXiv 2604.01204).

Splat i stores F features f_i. What is composited are their sines and cosines, so that a pixel p holds a weighted sum of
harmonics, h(p) = sum_i w_i(p) (sin f_i, cos f_i), and one network shared by the scene gives it its colour,

    colour(p) = sigmoid(network(h(p), Y(d_p))),

with Y the nine harmonics up to degree 2 of the pixel's ray d_p, and three hidden layers of 128 ReLUs.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor, nn

from nrfgs_lab.heads.features import FeatureHead
from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.appearance.sh import num_bases, sh_bases

RAY_DEGREE = 2
"""Degree of the harmonics of the ray."""


@dataclass
class DeferredConfig(AppearanceHeadConfig):
    """A network for each pixel. From the source: sines and cosines before compositing, harmonics of the ray, the
    network, its sigmoid, the start of the features, and the learning rates (`methods.py`). Our reading, where it says
    nothing or this host cannot follow:

    - a splat has one set of 16 features; the source has four of 12, between which it interpolates where the ray passes:
      here a splat has no texture
    - the first three features start at the point's colour
    - rays have length 1 in their harmonics; the source triples them
    - the image is blended with the background by accumulation, outside the network
    - rates fall exponentially, not by a cosine; weights have no running mean of their own (`--average-steps` has one);
      geometry is not frozen at the end; opacity and size are regularised as the densification says
    """

    _target: type = field(default_factory=lambda: Deferred)
    channels: int = 32
    """D: numbers that are composited for each splat; in pairs with harmonics"""
    harmonics: bool = True
    """composite sines and cosines of D / 2 features. Off: D features as they are"""
    hidden_width: int = 128
    """hidden units of each layer"""
    hidden_layers: int = 3
    """hidden layers"""

    def validate(self) -> None:
        least = 6 if self.harmonics else 3
        self.require(
            self.channels >= least and self.channels % 2 <= 1 - self.harmonics, "channels", f"even and at least {least}"
        )
        self.require(self.hidden_width >= 1, "hidden_width", "at least 1")
        self.require(self.hidden_layers >= 1, "hidden_layers", "at least 1")


class Deferred(FeatureHead):
    """Colours of pixels from composited harmonics and the ray, opacities from the base."""

    name = "deferred"

    def __init__(self, config: DeferredConfig):
        super().__init__()
        self.stored = config.channels // 2 if config.harmonics else config.channels
        widths = [config.channels + num_bases(RAY_DEGREE), *[config.hidden_width] * config.hidden_layers]
        layers = [layer for sizes in pairwise(widths) for layer in (nn.Linear(*sizes), nn.ReLU())]
        self.network = nn.Sequential(*layers, nn.Linear(widths[-1], 3), nn.Sigmoid())

    def seen(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor | None) -> Tensor:
        features = splats["features"].index_select(0, visible)
        return torch.cat([features.sin(), features.cos()], dim=-1) if self.config.harmonics else features

    def image_of(self, composited: Tensor, rays: Tensor) -> Tensor:
        return self.network(torch.cat([composited, sh_bases(RAY_DEGREE, rays)], dim=-1))
