# SPDX-License-Identifier: Apache-2.0
"""How surfaces answer light: the reflectance model, the lamps, the ambient light and the display curve.

Radiance that leaves point x with normal n towards the viewer v (all unit vectors, all radiances linear RGB):

    L(x, v) = (1 - g F_mean) rho(x) / pi * E(x)
              + g (1 - m) [ sum_l  F(v.h) D(n.h) V(n.l, n.v) (n.l) E_l(x)  +  F(n.v) A(r) / pi ]
              + g m F(n.v) L(x -> r)

- rho: painted diffuse reflectance. E(x) = sum_l (n.l) E_l(x) + A(n) o(x): irradiance of lamps and ambient light.
- E_l = intensity / distance^2 * shadow. A(n): irradiance of an environment that is linear in height. o: openness.
- F(c) = F0 + (1 - F0)(1 - c)^5 (Schlick). F_mean = F0 + (1 - F0)/21, its cosine-weighted mean over the hemisphere, for
  the strongest channel of F0: what the specular part takes the diffuse part does not give, averaged over views it
  never reflects more than arrives, and what a coloured metal leaves to its paint has no tint of its own.
- D: GGX (Trowbridge-Reitz) normal distribution. V: Smith's masking and shadowing over 4 (n.l)(n.v), as approximated by
  Hammon (2017).
- m: share of the specular part that is a perfect mirror, along r = 2 (n.v) n - v; the rest is the rough GGX lobe.
- g: the gloss dial. At g = 0 the viewer v appears nowhere, so a point's radiance is the same from everywhere.
"""

from dataclasses import dataclass

import numpy as np

from .geometry import Array, column, dot, normalize
from .textures import Colour


@dataclass(frozen=True)
class Finish:
    """The specular side of a material."""

    f0: Colour  # Reflectance at normal incidence, each in [0, 1]. Coloured for metals.
    roughness: float  # GGX roughness alpha of the lobe, in (0, 1].
    mirror: float  # Share m of the specular part that is a perfect mirror, in [0, 1].


@dataclass(frozen=True)
class Lamp:
    """A point light: irradiance at distance r, facing it, is intensity / r^2."""

    position: tuple[float, float, float]
    intensity: Colour


@dataclass(frozen=True)
class Ambient:
    """Light from all around, with radiance a + b d_z in direction d: below / above are its values at d_z = -1 / +1."""

    below: Colour
    above: Colour

    def irradiance(self, normals: Array) -> Array:
        """[3, N] for unit normals [3, N]: integral of (a + b d_z)(n.d)+ over directions = pi a + (2 pi / 3) b n_z."""
        below, above = column(self.below, normals.dtype), column(self.above, normals.dtype)
        return np.pi * 0.5 * (above + below) + (np.pi / 3.0) * (above - below) * normals[2]


def fresnel(f0: Array, cosine: Array) -> Array:
    """Schlick: f0 [3, 1] and cosine [N] in [0, 1] to [3, N]."""
    return f0 + (1.0 - f0) * (1.0 - cosine) ** 5


def mean_fresnel(f0: float) -> float:
    """Cosine-weighted mean of `fresnel` over the hemisphere: integral of 2 c (1 - c)^5 dc over [0, 1] = 1/21."""
    return f0 + (1.0 - f0) / 21.0


def ggx_lobe(n_dot_l: Array, n_dot_v: Array, n_dot_h: Array, roughness: float) -> Array:
    """D V of the rough lobe, [N], per steradian; zero where the light is behind the surface. Cosines are in [0, 1]."""
    a2 = roughness * roughness
    distribution = a2 / (np.pi * (n_dot_h * n_dot_h * (a2 - 1.0) + 1.0) ** 2)
    product, total = n_dot_l * n_dot_v, n_dot_l + n_dot_v
    # A light and a viewer both exactly at the horizon would divide zero by zero; the lobe is then cut by n.l = 0.
    visibility = 0.5 / np.maximum(2.0 * product * (1.0 - roughness) + total * roughness, 1e-6)
    return distribution * np.where(n_dot_l > 0.0, visibility, 0.0)


def mirror_direction(normals: Array, towards_viewer: Array) -> Array:
    """2 (n.v) n - v, [3, N]."""
    return 2.0 * dot(normals, towards_viewer) * normals - towards_viewer


def highlight(finish: Finish, normals: Array, to_lamp: Array, towards_viewer: Array) -> Array:
    """F D V (n.l) of one lamp, [3, N]: radiance out per irradiance (facing the lamp) in."""
    half = normalize(to_lamp + towards_viewer)
    n_dot_l = np.clip(dot(normals, to_lamp), 0.0, 1.0)
    n_dot_v = np.clip(dot(normals, towards_viewer), 0.0, 1.0)
    n_dot_h = np.clip(dot(normals, half), 0.0, 1.0)
    v_dot_h = np.clip(dot(towards_viewer, half), 0.0, 1.0)
    lobe = ggx_lobe(n_dot_l, n_dot_v, n_dot_h, finish.roughness) * n_dot_l
    return fresnel(column(finish.f0, normals.dtype), v_dot_h) * lobe


def tone_curve(radiance: Array) -> Array:
    """Linear radiance >= 0 to display values in [0, 1]: (1 - exp(-L))^(1 / 2.2).

    Smooth and growing, so highlights are compressed and not clipped: 1 is reached by rounding alone, beyond L = 17 in
    float32, which is more than the brightest lamp's reflection.
    """
    return (-np.expm1(-radiance)) ** (1.0 / 2.2)
