# SPDX-License-Identifier: Apache-2.0
"""Spherical Gaussians: a base colour and a few lobes of light, each about an axis of its own.

Seen from the direction d from camera to splat, splat i with base colour c and L = 3 lobes has

    colour = max(0, c + sum_{j <= L} a_j exp(|s_j| (d . mu_j - 1))),

with amplitude a_j (3 numbers, any sign), sharpness |s_j| (1 number) and unit axis mu_j (3 numbers, stored at any
length): 3 + 7 L = 24 colour numbers, half of what harmonics of degree 3 take. Opacity does not depend on the view.
Sources: the papers "SG-Splatting" (three lobes about the fixed axes x, y, z, from step 2,000) and "MEGS2" (free axes,
|s|), which this follows.

Axes start at x, y, z; amplitudes at zero, so that switching the lobes on changes nothing; sharpness at 2, so that
neighbours overlap (56 % of the height halfway to the next axis), and each lobe has directions to itself (2 % opposite
its axis).
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import (
    NEAR,
    AppearanceHead,
    AppearanceHeadConfig,
    SplatAppearance,
    base_colors,
    base_opacities,
    unit_vectors,
)

START_STEP = 2000
"""Training step of the first lobes; before it only the base colour is trained."""
INITIAL_SHARPNESS = 2.0
SHORTEST_AXIS = 1e-3
"""Stored axes shorter than this are divided by it instead of their length, which bounds their gradient."""


@dataclass
class SgConfig(AppearanceHeadConfig):
    """Spherical Gaussians with free axes."""

    _target: type = field(default_factory=lambda: SphericalGaussians)
    lobes: int = 3
    """L: lobes of each splat, 1 to 6. They start about x, y, z, -x, -y, -z, in this order."""

    def validate(self) -> None:
        # Two lobes that started alike would get the same gradients and stay alike.
        self.require(1 <= self.lobes <= 6, "lobes", "1 to 6, so that no two lobes start about the same axis")


class SphericalGaussians(AppearanceHead):
    """Colours from base and lobes, opacities from the base."""

    name = "sg"
    active: bool = True
    """whether there are lobes yet."""

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """Base colours "features_dc" [N, 3]; axes "sg_axes" [N, L, 3], of any length but zero; "sg_sharpness" [N, L],
        of any sign; amplitudes "sg_colors" [N, L, 3], in units of white."""
        lobes = self.config.lobes
        axes = torch.eye(3, device=rgb.device)
        return {
            **super().splat_params(rgb),
            "sg_axes": torch.cat([axes, -axes])[:lobes].repeat(len(rgb), 1, 1),
            "sg_sharpness": torch.full((len(rgb), lobes), INITIAL_SHARPNESS, device=rgb.device),
            "sg_colors": torch.zeros(len(rgb), lobes, 3, device=rgb.device),
        }

    def set_step(self, step: int) -> None:
        self.active = step >= START_STEP

    @property
    def phase(self) -> Hashable:
        return self.active

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        colors = base_colors(splats["features_dc"].index_select(0, visible))
        if self.active:
            colors = colors + self._lobes(splats, visible, camera_centers)
        opacities = base_opacities(splats["opacities"].index_select(0, visible))
        return SplatAppearance(colors.clamp_min(0.0), opacities)

    def _lobes(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> Tensor:
        """Sum of the visible splats' lobes, [M, 3]."""
        means = splats["means"].index_select(0, visible)
        directions = unit_vectors(means - camera_centers, NEAR * self.scene_unit)
        axes = unit_vectors(splats["sg_axes"].index_select(0, visible), SHORTEST_AXIS)
        sharpness = splats["sg_sharpness"].index_select(0, visible).abs()
        heights = torch.exp(sharpness * ((axes * directions[:, None]).sum(dim=-1) - 1.0))  # [M, L]
        return (heights[..., None] * splats["sg_colors"].index_select(0, visible)).sum(dim=1)
