# SPDX-License-Identifier: Apache-2.0
"""A trial: why does the field gain over harmonics? Two heads with its inputs, bound and rates, without opacity residual.

NERFSTUDIO_METHOD_CONFIGS="linear-basis=nrfgs_lab.heads.why:linear_basis,own-network=nrfgs_lab.heads.why:own_network"
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.head import AppearanceHead, AppearanceHeadConfig, SplatAppearance, base_colors, base_opacities
from nrfgs_ns.appearance.nrf import fourier_bands, view_geometry
from nrfgs_ns.appearance.sh import num_bases, sh_bases
from nrfgs_ns.method_config import SUITED, adam, method, preset


@dataclass
class LinearBasisConfig(AppearanceHeadConfig):
    """Harmonics whose coefficients are linear in a latent, by one matrix of the scene."""

    _target: type = field(default_factory=lambda: LinearBasis)
    latent_dim: int = 32
    degree: int = 3


class LinearBasis(AppearanceHead):
    """colour = c + 0.2 tanh(sum_j (W z)_j Y_j(d)), with a shared matrix W, zero at the start."""

    name = "linear-basis"

    def __init__(self, config: LinearBasisConfig):
        super().__init__()
        self.config = config
        self.matrix = nn.Linear(config.latent_dim, 3 * (num_bases(config.degree) - 1))
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
        residual = torch.einsum("mb,mbc->mc", bases, self.matrix(latents).view(len(means), -1, 3))
        colors = base_colors(constant) + 0.2 * torch.tanh(residual)
        return SplatAppearance(colors.clamp_min(0.0), base_opacities(logits))


@dataclass
class OwnNetworkConfig(AppearanceHeadConfig):
    """A network for each splat, with the field's two branches, without a latent."""

    _target: type = field(default_factory=lambda: OwnNetwork)
    width: int = 64
    bands: int = 3


class OwnNetwork(AppearanceHead):
    """The field's branches, each splat with weights of its own."""

    name = "own-network"

    def __init__(self, config: OwnNetworkConfig):
        super().__init__()
        self.config = config

    def splat_params(self, rgb):
        def linear(inputs: int, outputs: int) -> Tensor:
            return (2 * torch.rand(len(rgb), inputs + 1, outputs, device=rgb.device) - 1) / inputs**0.5

        width, low, high = self.config.width, 3 + 1 + 1 + 9, 3 + 1 + 6 * (self.config.bands - 1)
        last = {"low2": rgb.new_zeros(len(rgb), width + 1, 3), "high2": rgb.new_zeros(len(rgb), width + 1, 4)}
        return {**super().splat_params(rgb), "low1": linear(low, width), "high1": linear(high, width), **last}

    def forward(self, splats, visible, camera_centers):
        means, constant, logits = (
            splats[name].index_select(0, visible) for name in ("means", "features_dc", "opacities")
        )
        color = base_colors(constant)
        directions, log_distance = view_geometry(means, camera_centers, 0.01, self.scene_unit)
        low, high = fourier_bands(directions, self.config.bands)

        def branch(inputs: Tensor, name: str) -> Tensor:
            one = inputs.new_ones(len(inputs), 1)
            first, second = (splats[f"{name}{layer}"].index_select(0, visible) for layer in (1, 2))
            hidden = torch.einsum("mi,mio->mo", torch.cat([inputs, one], dim=1), first).relu()
            return torch.einsum("mi,mio->mo", torch.cat([hidden, one], dim=1), second)

        out = branch(torch.cat([color, torch.sigmoid(logits), log_distance, low], dim=1), "low")
        detail = branch(torch.cat([color, log_distance, high], dim=1), "high")
        residual = 0.2 * torch.tanh(out + torch.sigmoid(detail[:, 3:]) * detail[:, :3])
        return SplatAppearance((color + residual).clamp_min(0.0), base_opacities(logits))


SHARED = {"latents": adam(0.0025), "field": adam(5e-3, lr_final=5e-4)}
OWN = {name: adam(5e-3, lr_final=5e-4) for name in ("low1", "low2", "high1", "high2")}
MODEL = {**SUITED, "few_views": "auto"}
linear_basis, own_network = (
    preset(name, method(name, config, "", **rates), "A trial.", model=MODEL, max_num_iterations=0)
    for name, config, rates in (("linear-basis", LinearBasisConfig(), SHARED), ("own-network", OwnNetworkConfig(), OWN))
)
