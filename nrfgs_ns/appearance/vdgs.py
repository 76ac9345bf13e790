# SPDX-License-Identifier: Apache-2.0
"""VDGS: spherical harmonics whose opacity one network, shared by the scene, turns down with the view.

Seen from the direction d from camera to splat, splat i with mean x, opacity logit o and coefficients k has

    f       = sigmoid(network(d, grid(x))),
    opacity = sigmoid(o) f,       colour = max(0, 1/2 + sum_{l <= L} sum_m k_{l, m} Y_{l, m}(d)),

where grid is a hash grid of the mean in scene units (`hash_grid.py`: 4 levels of 4 features, 524,288 shared numbers)
and the network has two hidden layers of 32 leaky ReLUs: 19 -> 32 -> 32 -> 1, 1,729 weights. f starts near 1/2. Source:
the paper "Gaussian Splatting with NeRF-based Color and Opacity", called VDGS, in the mode that multiplies opacity.

Grid and network have the reference's optimiser, Adam at 1e-3 without a schedule; all else is the host's, opacity resets
included, which the reference switches off. Pruning sees sigmoid(o), except in `mcmc` (the largest opacity shown).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.hash_grid import HashGrid, kernels_run_on
from nrfgs_ns.appearance.head import NEAR, Component, SplatAppearance, layers, unit_vectors
from nrfgs_ns.appearance.sh import ShConfig, SphericalHarmonics, eval_sh

HIDDEN_WIDTH = 32
"""Units of each hidden layer."""


@dataclass
class VdgsConfig(ShConfig):
    """Spherical harmonics and a view-dependent factor. The defaults are the paper's."""

    _target: type = field(default_factory=lambda: ViewDirectionFactors)
    grid_base_resolution: int = 16
    """lattice steps per scene unit on the coarsest level."""

    def validate(self) -> None:
        super().validate()
        self.require(self.grid_base_resolution >= 1, "grid_base_resolution", "at least 1")


class ViewDirectionFactors(SphericalHarmonics):
    """Harmonics, and the base opacity multiplied by the network's factor."""

    name = "vdgs"
    is_harmonics = False

    def __init__(self, config: VdgsConfig):
        super().__init__(config)
        self.grid = HashGrid(config.grid_base_resolution)
        self.network = nn.Sequential(*layers(3 + self.grid.width, HIDDEN_WIDTH, HIDDEN_WIDTH, 1))

    def try_kernels(self, device: torch.device) -> None:
        super().try_kernels(device)
        kernels_run_on(device)

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        means, coefficients, opacities = self.rows(splats, visible, camera_centers)
        directions = unit_vectors(means - camera_centers, NEAR * self.scene_unit)
        factors = torch.sigmoid(self.network(torch.cat([directions, self.grid(means / self.scene_unit)], dim=-1)))
        colors = eval_sh(self.active_degree, directions, coefficients) + 0.5
        return SplatAppearance(colors.clamp_min(0.0), opacities * factors[:, 0])

    def components(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> dict[str, Component]:
        """The harmonics' "residual", and the factor's "opacity residual"."""
        seen = self(splats, visible, camera_centers)
        base = self.base_appearance(splats, visible)
        return {
            "residual": Component(seen.colors - base.colors, "color"),
            "opacity residual": Component((seen.opacities - base.opacities)[:, None], "opacity"),
        }
