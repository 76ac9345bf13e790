# SPDX-License-Identifier: Apache-2.0
"""GSNB: spherical harmonics, and as many basis functions that the scene learns.

Seen from the direction d from camera to splat, with coefficients k per splat and one network phi for the scene,

    colour = max(0, 1/2 + sum_{j < B_active} k_j Y_j(d) + rho sum_{j < B} k_j phi_j(d)),

where B = 16 at degree 3 and both sums have the same 48 coefficients. phi is the Fourier encoding of d with 6 bands,
two hidden layers of 64 leaky ReLUs, and tanh: 39 -> 64 -> 64 -> 16, 7,760 shared weights. rho grows from 0 to 1 over
the first 5,000 steps. The encoding keeps d itself: sines and cosines of whole multiples of pi cannot tell +x from -x.
Opacity does not depend on the view. Source: the paper "Gaussian Splatting with Neural Basis Extension", called GSNB.

The reference's resolution ramp, patch loss and learning rates are not the colour model: all methods have the host's.
Only the basis network has the reference's optimiser, AdamW at 1e-3 (docs/deviations.md).
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.head import NEAR, SplatAppearance, layers, unit_vectors
from nrfgs_ns.appearance.nrf import BAND_DIM, fourier_bands
from nrfgs_ns.appearance.sh import ShConfig, SphericalHarmonics, eval_sh, num_bases

RAMP_STEPS = 5000
"""Training steps over which the learnt basis is faded in."""
BANDS = 6
"""Fourier bands of the view direction."""
HIDDEN_WIDTH = 64
"""Units of each hidden layer."""


@dataclass
class GsnbConfig(ShConfig):
    """Spherical harmonics and a learnt basis. The defaults are the paper's."""

    _target: type = field(default_factory=lambda: NeuralBasis)
    raw_direction: bool = True
    """whether the direction itself stands beside its bands; its reference has the bands alone, 36 inputs"""


class NeuralBasis(SphericalHarmonics):
    """Colours from harmonics and learnt functions, opacities from the base."""

    name = "gsnb"
    is_harmonics = False

    def __init__(self, config: GsnbConfig):
        super().__init__(config)
        self.ramp = 1.0
        """rho: weight of the learnt basis."""
        inputs = 3 * config.raw_direction + BAND_DIM * BANDS
        self.basis = nn.Sequential(*layers(inputs, HIDDEN_WIDTH, HIDDEN_WIDTH, num_bases(config.degree)), nn.Tanh())

    def set_step(self, step: int) -> None:
        super().set_step(step)
        self.ramp = min(step / RAMP_STEPS, 1.0)

    @property
    def phase(self) -> Hashable:
        return super().phase, self.ramp

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        means, coefficients, opacities = self.rows(splats, visible, camera_centers)
        directions = unit_vectors(means - camera_centers, NEAR * self.scene_unit)
        inputs = torch.cat(fourier_bands(directions, BANDS), dim=-1)
        learnt = self.basis(inputs if self.config.raw_direction else inputs[:, 3:])  # [M, B]
        colors = eval_sh(self.active_degree, directions, coefficients)
        colors = colors + self.ramp * (learnt[..., None] * coefficients).sum(dim=1)
        return SplatAppearance((colors + 0.5).clamp_min(0.0), opacities)
