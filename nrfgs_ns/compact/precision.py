# SPDX-License-Identifier: Apache-2.0
"""How finely a compact file holds its numbers."""

from dataclasses import dataclass

from nrfgs_ns.errors import InputError


@dataclass
class Precision:
    """Steps of the grids. No number is off by more than half of its step."""

    means: float = 0.03125
    """largest step of a coordinate, in standard deviations of the median splat; 10 to 21 bits for each axis. Finer than
    the others, because a splat smaller than the median suffers more, and pixels notice places first"""
    quats: int = 8
    """bits of each of a rotation's three smaller components"""
    scales: float = 0.0625
    """step of a log scale: a sixteenth is 6 % of a size"""
    opacities: float = 0.0625
    """step of an opacity's logit: a sixteenth is at most 1/64 of opacity"""
    colors: float = 1 / 512
    """step of a base colour, in units of white"""
    latents: float = 0.0625
    """step of a latent's components, in standard deviations of the strongest"""

    def validate(self) -> None:
        """Raise InputError, naming the field, if a value cannot work."""
        for name in ("means", "scales", "opacities", "colors", "latents"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"--compact.precision.{name} is {getattr(self, name)}; it must be positive.")
        if not 2 <= self.quats <= 16:
            raise InputError(f"--compact.precision.quats is {self.quats}; use 2 to 16 bits.")
