# SPDX-License-Identifier: Apache-2.0
"""A trial: why does the field gain over harmonics? Harmonics whose coefficients are linear in a latent, with the
field's bound and rates and with or without its opacity residual; and harmonics with a rate that decays.

NERFSTUDIO_METHOD_CONFIGS="linear-basis=nrfgs_lab.heads.why:linear_basis,linear-opacity=nrfgs_lab.heads.why:linear_opacity,harmonics-decay=nrfgs_lab.heads.why:harmonics_decay"
"""

from dataclasses import dataclass, field, replace

import torch
from torch import nn

from nrfgs_ns.appearance.head import AppearanceHead, AppearanceHeadConfig, SplatAppearance, base_colors
from nrfgs_ns.appearance.nrf import bounded_opacity, view_geometry
from nrfgs_ns.appearance.sh import ShConfig, num_bases, sh_bases
from nrfgs_ns.method_config import SUITED, adam, method, preset


@dataclass
class LinearBasisConfig(AppearanceHeadConfig):
    """Harmonics whose coefficients are linear in a latent, by one matrix of the scene."""

    _target: type = field(default_factory=lambda: LinearBasis)
    latent_dim: int = 32
    degree: int = 3
    opacity_scale: float = 0.0
    """of the opacity residual, on the logit"""

    def trusted(self, share):
        return replace(self, opacity_scale=share * self.opacity_scale)


class LinearBasis(AppearanceHead):
    """colour = c + 0.2 tanh(sum_j (W z)_j Y_j(d)), and the logit likewise, with a shared matrix W, zero at the
    start."""

    name = "linear-basis"

    def __init__(self, config: LinearBasisConfig):
        super().__init__()
        self.config = config
        self.matrix = nn.Linear(config.latent_dim, 4 * (num_bases(config.degree) - 1))
        nn.init.zeros_(self.matrix.weight)
        nn.init.zeros_(self.matrix.bias)

    def splat_params(self, rgb):
        latents = 0.1 * torch.randn(len(rgb), self.config.latent_dim, device=rgb.device)
        return {**super().splat_params(rgb), "latents": latents}

    def forward(self, splats, visible, camera_centers):
        names = "means", "latents", "features_dc", "opacities"
        means, latents, constant, logits = (splats[name].index_select(0, visible) for name in names)
        directions, _ = view_geometry(means, camera_centers, 0.01, self.scene_unit)
        bases = sh_bases(self.config.degree, directions)[:, 1:]
        residual = torch.einsum("mb,mbc->mc", bases, self.matrix(latents).view(len(means), -1, 4)).tanh()
        colors = base_colors(constant) + 0.2 * residual[:, :3]
        opacities = bounded_opacity(logits, residual[:, 3:], self.config.opacity_scale, "logit").squeeze(-1)
        return SplatAppearance(colors.clamp_min(0.0), opacities)


LEARNT = {"latents": adam(0.0025), "field": adam(5e-3, lr_final=5e-4)}
linear_basis, linear_opacity, harmonics_decay = (
    preset(
        name, method(name, head, "", **rates), "A trial.", model={**SUITED, "few_views": views}, max_num_iterations=0
    )
    for name, head, rates, views in (
        ("linear-basis", LinearBasisConfig(), LEARNT, "auto"),
        ("linear-opacity", LinearBasisConfig(opacity_scale=0.4), LEARNT, "auto"),
        ("harmonics-decay", ShConfig(), {"features_rest": adam(0.002, lr_final=0.0025 / 20)}, "off"),
    )
)
