# SPDX-License-Identifier: Apache-2.0
"""Diffuse and specular images decoded by convolutions, after Latent-SpecGS (Wang et al., arXiv 2409.05868).

Splat i stores diffuse features, specular features s_i, and shows them in a mask m_i that depends on the view. All are
composited, and two decoders of small convolutions, shared by the scene, turn them into an image:

    m_i   = sigmoid(small network(s_i, Y(d_i)))                   d_i from the camera to the splat
    image = diffuse(F_d) + M sigmoid(specular(F_s, Y(d)))         d the pixels' rays

with F_d, F_s and M the composited features and mask, and Y the harmonics up to degree 3 but for the constant.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from nrfgs_lab.heads.features import FeatureHead
from nrfgs_ns.appearance.head import NEAR, AppearanceHeadConfig, unit_vectors
from nrfgs_ns.appearance.sh import num_bases, sh_bases

DIRECTION_DEGREE = 3
"""Degree of the harmonics of directions, whose constant is left out."""
DIRECTION_DIM = num_bases(DIRECTION_DEGREE) - 1


@dataclass
class LatentSpecConfig(AppearanceHeadConfig):
    """Diffuse and specular decoders. From the source: two sets of features for each splat, a mask of each splat by a
    small network of its direction, the sum of a diffuse and a masked specular image, directions of pixels for the
    specular decoder alone, ELUs, and the features' learning rate. Our reading, where it is open or we keep it small:

    - 8 diffuse and 7 specular features, so that 16 numbers are composited, for which the rasterizer has kernels
    - the mask's network sees the specular features in place of the splat's normal
    - each decoder is two convolutions of 3 x 3 and one of 1 x 1, padded by zeros: a pixel sees 5 x 5. The source's
      diffuse decoder is a U-Net of three halvings, its specular one has residual blocks and sees 11 x 11
    - harmonics encode directions, the source has sines and cosines of four frequencies
    - both images end in a sigmoid; the image is blended with the background by accumulation
    - the diffuse image has no loss of its own (the source weighs one by 0.05)
    - features start as in `features.py`; learning rates of the networks (`methods.py`)
    """

    _target: type = field(default_factory=lambda: LatentSpec)
    diffuse_dim: int = 8
    """diffuse features of a splat"""
    specular_dim: int = 7
    """specular features of a splat"""
    hidden_width: int = 32
    """channels between the convolutions, and hidden units of the mask's network"""

    def validate(self) -> None:
        self.require(self.diffuse_dim >= 3, "diffuse_dim", "at least 3")
        self.require(self.specular_dim >= 1, "specular_dim", "at least 1")
        self.require(self.hidden_width >= 1, "hidden_width", "at least 1")


class LatentSpec(FeatureHead):
    """Colours of pixels from composited features, a mask and the ray, opacities from the base."""

    name = "latent-spec"

    def __init__(self, config: LatentSpecConfig):
        super().__init__()
        self.stored = config.diffuse_dim + config.specular_dim
        width, of_specular = config.hidden_width, config.specular_dim + DIRECTION_DIM
        self.mask = nn.Sequential(nn.Linear(of_specular, width), nn.ELU(), nn.Linear(width, 1), nn.Sigmoid())
        self.diffuse = decoder(config.diffuse_dim, width)
        self.specular = decoder(of_specular, width)

    def seen(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor | None) -> Tensor:
        features = splats["features"].index_select(0, visible)
        if camera_centers is None:
            return torch.cat([features, torch.zeros_like(features[:, :1])], dim=-1)
        towards = splats["means"].index_select(0, visible) - camera_centers
        seen_along = encoded(unit_vectors(towards, NEAR * self.scene_unit))
        mask = self.mask(torch.cat([features[:, self.config.diffuse_dim :], seen_along], dim=-1))
        return torch.cat([features, mask], dim=-1)

    def image_of(self, composited: Tensor, rays: Tensor) -> Tensor:
        diffuse, specular, mask = composited.split([self.config.diffuse_dim, self.config.specular_dim, 1], dim=-1)
        light = decoded(self.specular, torch.cat([specular, encoded(rays)], dim=-1))
        return decoded(self.diffuse, diffuse) + mask * light


def encoded(directions: Tensor) -> Tensor:
    """Harmonics of unit directions [..., 3] without the constant, [..., 15]."""
    return sh_bases(DIRECTION_DEGREE, directions)[..., 1:]


def decoder(inputs: int, width: int) -> nn.Sequential:
    """Convolutions from features to colours in [0, 1]."""
    first, second = nn.Conv2d(inputs, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)
    return nn.Sequential(first, nn.ELU(), second, nn.ELU(), nn.Conv2d(width, 3, 1), nn.Sigmoid())


def decoded(network: nn.Sequential, features: Tensor) -> Tensor:
    """The image [H, W, 3] of features [H, W, F]."""
    return network(features.permute(2, 0, 1)[None])[0].permute(1, 2, 0)
