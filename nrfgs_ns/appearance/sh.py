# SPDX-License-Identifier: Apache-2.0
"""Spherical harmonics: the colour model of 3DGS, and the first thing that anyone compares with.

    colour = max(0, 1/2 + sum_{l <= L} sum_m k_{l, m} Y_{l, m}(d)),    d from the camera to the splat,

with L growing by one every `degree_interval` steps up to `degree`. Opacity does not depend on the view.
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import AppearanceHead, AppearanceHeadConfig, SplatAppearance, base_opacities, picked
from nrfgs_ns.appearance.spherical_harmonics import eval_sh, kernels_run_on, num_bases


@dataclass
class ShConfig(AppearanceHeadConfig):
    """Spherical harmonics, as in splatfacto."""

    STEPS = ("degree_interval",)
    _target: type = field(default_factory=lambda: SphericalHarmonics)
    """the head class that this configuration builds"""
    degree: int = 3
    """highest degree, 0 to 3. 0 is a colour that does not depend on the view."""
    degree_interval: int = 1000
    """training steps after which the next degree is switched on."""

    def validate(self) -> None:
        self.require(0 <= self.degree <= 3, "degree", "0, 1, 2 or 3")
        self.require(self.degree_interval >= 1, "degree_interval", "at least 1")


class SphericalHarmonics(AppearanceHead):
    """Colours from harmonics, opacities from the base."""

    name = "sh"
    is_harmonics = True

    def __init__(self, config: ShConfig):
        super().__init__()
        self.config = config
        self.sh_degree = config.degree
        self.active_degree = config.degree

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """Coefficients: "features_dc" [N, 3], and the higher degrees' "features_rest" [N, (degree + 1)^2 - 1, 3]."""
        rest = torch.zeros(len(rgb), num_bases(self.config.degree) - 1, 3, device=rgb.device)
        return {**super().splat_params(rgb), "features_rest": rest}

    def try_kernels(self, device: torch.device) -> None:
        kernels_run_on(device)

    def set_step(self, step: int) -> None:
        self.active_degree = min(step // self.config.degree_interval, self.config.degree)

    @property
    def phase(self) -> Hashable:
        return self.active_degree

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        means, constant, rest, logits = (
            picked(splats[name], visible, camera_centers)
            for name in ("means", "features_dc", "features_rest", "opacities")
        )
        coefficients = torch.cat([constant[:, None], rest], dim=1)
        return SplatAppearance(
            colors=(eval_sh(self.active_degree, means - camera_centers, coefficients) + 0.5).clamp_min(0.0),
            opacities=base_opacities(logits),
        )

    def coefficients(self, splats: Mapping[str, Tensor], visible: Tensor) -> Tensor:
        """All coefficients of the visible splats, [M, (degree + 1)^2, 3]."""
        constant = splats["features_dc"].index_select(0, visible)[:, None]
        return torch.cat([constant, splats["features_rest"].index_select(0, visible)], dim=1)
