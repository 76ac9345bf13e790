# SPDX-License-Identifier: Apache-2.0
"""What is painted on the surfaces: diffuse reflectance and sky glow as smooth functions of position.

Every pattern is band-limited on purpose: at the default image size its finest wave spans several pixels on the surfaces
that fill the frame, and the ground's pattern fades with distance. Splats have detail to fit, and no image
contains aliasing that no model could explain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .geometry import Array, column, smoothstep

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Waves:
    """Smooth noise in [-1, 1]: plane waves of random direction and phase at a few frequencies.

    noise(p) = sum_j a_j sin(w_j . p + phi_j), amplitudes a_j proportional to 1 / |w_j|, with sum of a_j = 1.
    """

    wave_vectors: Array  # [J, 3], radians per unit length.
    phases: Array  # [J]
    amplitudes: Array  # [J]

    @classmethod
    def random(cls, rng: np.random.Generator, frequencies: Sequence[float], per_frequency: int = 3) -> "Waves":
        """Draw `per_frequency` waves at each of the frequencies (radians per unit length)."""
        lengths = np.repeat(np.asarray(frequencies, dtype=np.float64), per_frequency)
        vectors = rng.normal(size=(len(lengths), 3))
        vectors *= (lengths / np.linalg.norm(vectors, axis=1))[:, None]
        return cls(vectors, rng.uniform(0.0, 2.0 * np.pi, len(lengths)), (1.0 / lengths) / (1.0 / lengths).sum())

    def __call__(self, points: Array) -> Array:
        """[3, N] to [N]."""
        total = np.zeros_like(points[0])
        for vector, phase, amplitude in zip(self.wave_vectors, self.phases, self.amplitudes, strict=True):
            w = vector.astype(points.dtype)
            angle = w[0] * points[0] + w[1] * points[1] + w[2] * points[2] + points.dtype.type(phase)
            total += points.dtype.type(amplitude) * np.sin(angle)
        return total


def soft_square_wave(x: Array, steepness: float) -> Array:
    """+1 and -1 on alternate unit intervals, with edges about 1 / steepness wide: tanh(steepness sin(pi x))."""
    return np.tanh(steepness * np.sin(np.pi * x))


def blend(low: Sequence[float], high: Sequence[float], weight: Array) -> Array:
    """Colours [3, N] between two colours, weight [N] in [0, 1]."""
    low, high = column(low, weight.dtype), column(high, weight.dtype)
    return low + (high - low) * weight


def darken(colour: Array, noise: Array, grain: float) -> Array:
    """Scale colours [3, N] by 1 - grain (1 - noise) / 2: between 1 - grain and 1, so reflectance stays below one."""
    return colour * (1.0 - 0.5 * grain * (1.0 - noise))


@dataclass(frozen=True)
class Paint:
    """A two-colour pattern on a solid, from its local coordinates in [-1, 1]^3.

    weight = 1/2 + 1/2 prod_a tanh(steepness sin(pi repeats_a q_a)) over the axes a with repeats: stripes along one
    axis, a checker along two or three. The colour between `low` and `high` is then darkened by the noise at q.
    """

    low: Colour
    high: Colour
    repeats: Colour  # Fields per unit length along x, y, z; 0 leaves the axis out.
    steepness: float = 3.0
    grain: float = 0.25

    def __call__(self, local: Array, noise: Waves) -> Array:
        """Reflectance [3, N] in [0, 1]."""
        pattern = np.ones_like(local[0])
        for axis, repeats in enumerate(self.repeats):
            if repeats:
                pattern = pattern * soft_square_wave(repeats * local[axis], self.steepness)
        return darken(blend(self.low, self.high, 0.5 + 0.5 * pattern), noise(local), self.grain)


def checkered_floor(points: Array, noise: Waves) -> Array:
    """Reflectance [3, N] at ground points [3, N]: tiles of half a world unit, which fade to an even tone away from the
    centre, to exp(-1) of their contrast at 4 world units."""
    x, y = points[0], points[1]
    checker = soft_square_wave(x / 0.5, steepness=4.0) * soft_square_wave(y / 0.5, steepness=4.0)
    stone = blend((0.07, 0.08, 0.11), (0.80, 0.73, 0.63), 0.5 + 0.5 * checker)
    far = column((0.46, 0.42, 0.40), points.dtype)
    return far + (darken(stone, noise(points), grain=0.35) - far) * np.exp(-(x * x + y * y) / 4.0**2)


@dataclass(frozen=True)
class Sky:
    """The glow of the dome: a gradient from horizon to zenith, a soft lamp patch for each light, and thin cloud.

    L(d) = [horizon + (zenith - horizon) smoothstep(d_z / 0.6)] (1 + cloud noise(d))
           + sum_l patch_l exp(sharpness (d . u_l - 1))
    """

    horizon: Colour
    zenith: Colour
    patches: tuple[tuple[Array, Array], ...]  # (towards, radiance) of the lamp patches, [3] each; `towards` is unit.
    sharpness: float = 60.0
    cloud: float = 0.3

    def __call__(self, directions: Array, noise: Waves) -> Array:
        """Radiance [3, N] of the dome in unit directions [3, N] from its centre."""
        glow = blend(self.horizon, self.zenith, smoothstep(directions[2] / 0.6)) * (
            1.0 + self.cloud * noise(directions)
        )
        for towards, radiance in self.patches:
            cosine = (column(towards, directions.dtype) * directions).sum(axis=0)
            glow = glow + column(radiance, directions.dtype) * np.exp(self.sharpness * (cosine - 1.0))
        return glow
