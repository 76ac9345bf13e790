# SPDX-License-Identifier: Apache-2.0
"""The field at the splat, and a small network at the pixel that adds a bounded residual to its image."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.head import Component, SplatAppearance
from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig
from nrfgs_ns.appearance.sh import num_bases, sh_bases


@dataclass
class BothConfig(NrfConfig):
    """Options of the head."""

    _target: type = field(default_factory=lambda: Both)
    features: int = 13
    pixel_width: int = 32
    pixel_scale: float = 0.2


class Both(NeuralResidualField):
    """The field, whose image a network of two hidden layers changes by at most `pixel_scale`."""

    name = "both"
    at_pixel = True

    def __init__(self, config: BothConfig):
        super().__init__(config)
        w = config.pixel_width
        self.pixel = nn.Sequential(
            nn.Linear(3 + config.features + num_bases(2), w), nn.ReLU(), nn.Linear(w, w), nn.ReLU(), nn.Linear(w, 3)
        )
        nn.init.zeros_(self.pixel[-1].weight)
        nn.init.zeros_(self.pixel[-1].bias)

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        return {
            **super().splat_params(rgb),
            "features": 0.5 * torch.randn(len(rgb), self.config.features, device=rgb.device),
        }

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        seen = super().forward(splats, visible, camera_centers)
        return seen._replace(colors=torch.cat([seen.colors, splats["features"].index_select(0, visible)], dim=-1))

    def base_appearance(self, splats: Mapping[str, Tensor], visible: Tensor) -> SplatAppearance:
        seen = super().base_appearance(splats, visible)
        return seen._replace(colors=torch.cat([seen.colors, splats["features"].index_select(0, visible)], dim=-1))

    def neutral_loss(self, splats, visible, camera_centers):
        return None

    def components(self, splats, visible, camera_centers) -> dict[str, Component]:
        return {}

    def image_of(self, composited: Tensor, rays: Tensor) -> Tensor:
        out = self.pixel(torch.cat([composited, sh_bases(2, rays)], dim=-1))
        return (composited[..., :3] + self.config.pixel_scale * torch.tanh(out)).clamp_min(0.0)
