# SPDX-License-Identifier: Apache-2.0
"""A network for each pixel, after Neural Harmonic Textures (Condor et al., arXiv 2604.01204).

Splat i stores F features f_i. What is composited are their sines and cosines, so that a pixel p holds a weighted sum of
harmonics, h(p) = sum_i w_i(p) (sin f_i, cos f_i), and one network shared by the scene gives it its colour,

    colour(p) = sigmoid(network(h(p), Y(d_p))),

with Y the nine harmonics up to degree 2 of the pixel's ray d_p, and three hidden layers of 128 ReLUs.

With `interior`, features are four sets for each splat, f_i(u) = f_i + G_i u with u its own axes in standard deviations.
The ray d_p meets the splat, whose centre is seen along d_i, where its density along the ray is largest, u = Q_i (d_p -
d_i) to first order in the angle. What is composited then is h(f_i) + h'(f_i) G_i Q_i (d_p - d_i), linear in d_p: any
rasterizer of 4 D channels draws it, and the pixel multiplies by its ray.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor, nn

from nrfgs_lab.heads.features import FeatureHead
from nrfgs_ns.appearance.head import NEAREST, AppearanceHeadConfig
from nrfgs_ns.appearance.sh import num_bases, sh_bases
from nrfgs_ns.rasterizer.torch_cpu.projection import directions, rotation_matrices

RAY_DEGREE = 2
"""Degree of the harmonics of the ray."""
BLUR = 5e-4
"""Standard deviation of the rasterizer's blur, as an angle: about half a pixel of a picture of a thousand."""
NEEDLE = 3e-3
"""Least width over length of a splat on the image: its square is far above float32's rounding."""


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
    interior: bool = False
    """four sets of features for each splat, interpolated in its inside; without noise on the view"""

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
        self.config = config
        self.features = config.channels // 2 if config.harmonics else config.channels
        self.stored = 4 * self.features if config.interior else self.features
        widths = [config.channels + num_bases(RAY_DEGREE), *[config.hidden_width] * config.hidden_layers]
        layers = [layer for sizes in pairwise(widths) for layer in (nn.Linear(*sizes), nn.ReLU())]
        self.network = nn.Sequential(*layers, nn.Linear(widths[-1], 3), nn.Sigmoid())

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """As `FeatureHead` has them; splats start without an interior."""
        params = super().splat_params(rgb)
        params["features"][:, self.features :] = 0.0
        return params

    def seen(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor | None) -> Tensor:
        features, slopes = splats["features"].index_select(0, visible).tensor_split([self.features], dim=1)
        values = torch.cat([features.sin(), features.cos()], dim=1) if self.config.harmonics else features
        if not self.config.interior:
            return values
        slopes = slopes.unflatten(1, (-1, 3))
        if self.config.harmonics:
            slopes = torch.cat([features.cos()[..., None] * slopes, -features.sin()[..., None] * slopes], dim=1)
        if camera_centers is None:
            return torch.cat([values, torch.zeros_like(slopes).flatten(1)], dim=1)
        geometry = (splats[name].index_select(0, visible) for name in ("means", "quats", "scales"))
        places, along = places_of_rays(*geometry, camera_centers, NEAREST * self.scene_unit)
        slopes = slopes @ places
        return torch.cat([values - (slopes @ along[..., None]).squeeze(-1), slopes.flatten(1)], dim=1)

    def image_of(self, composited: Tensor, rays: Tensor) -> Tensor:
        if self.config.interior:
            values, slopes = composited.tensor_split([self.config.channels], dim=-1)
            composited = values + (slopes.unflatten(-1, (-1, 3)) @ rays[..., None]).squeeze(-1)
        return self.network(torch.cat([composited, sh_bases(RAY_DEGREE, rays)], dim=-1))


def places_of_rays(
    means: Tensor, quats: Tensor, scales: Tensor, camera_centers: Tensor, nearest: float
) -> tuple[Tensor, Tensor]:
    """Q [M, 3, 3] and d [M, 3]: the ray along unit vector r is nearest to a splat's centre, in its axes and standard
    deviations, at Q (r - d). With A [M, 2, 3] the splat's axes in the plane across d at the centre's distance, that is
    A^T (A A^T)^-1, the conditional mean of a Gaussian. `scales` are logarithms."""
    towards = means - camera_centers
    distance = towards.norm(dim=1, keepdim=True).clamp_min(nearest)
    along = towards / distance
    least = torch.nn.functional.one_hot(along.detach().abs().argmin(dim=1), 3).to(along)
    first = torch.nn.functional.normalize(torch.linalg.cross(least, along), dim=1)
    across = torch.stack([first, torch.linalg.cross(along, first)], dim=1)  # [M, 2, 3]
    axes = rotation_matrices(directions(quats)).permute(2, 0, 1) * scales.exp()[:, None, :]
    seen = across @ axes / distance[..., None]  # [M, 2, 3], in angles
    (a, b), (_, c) = (seen @ seen.mT).permute(1, 2, 0)
    floor = BLUR**2 + NEEDLE**2 * (a + c)
    a, c = a + floor, c + floor
    inverse = torch.stack([c, -b, -b, a], dim=1).unflatten(1, (2, 2)) / (a * c - b * b)[:, None, None]
    return seen.mT @ inverse @ across, along
