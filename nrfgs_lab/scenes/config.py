# SPDX-License-Identifier: Apache-2.0
"""Options of a procedural scene."""

import math
from dataclasses import dataclass

from nrfgs_ns.errors import InputError


@dataclass(frozen=True)
class SceneConfig:
    """One procedural scene and the data set made from it. Equal configs give byte-identical data sets.

    InputError if gloss or seed, which `nrfgs demo` takes, is outside its range.
    """

    gloss: float = 1.0  # Weight g of everything specular, in [0, 1]. At 0 each point has one colour, whatever the view.
    studio: bool = False  # A dozen lamps, one satin finish, no mirrors: small highlights, and nothing else reflected.
    arc: float = 360.0  # Range of the cameras' azimuths, degrees, in (0, 360].
    views: int = 48  # Number of images, at least 2.
    width: int = 200  # Image width, pixels.
    height: int = 150  # Image height, pixels.
    samples: int = 2  # Rays per pixel side: a pixel is the mean of samples x samples rays on a regular grid.
    field_of_view: float = 50.0  # Horizontal field of view, degrees, in (0, 120].
    points: int = 5000  # Surface points in the sparse point cloud.
    test_every: int = 8  # Images 0, n, 2n, ... by name are test images; at least 2, so that some image trains.
    seed: int = 0  # Decides the noise in the textures, the jitter of the cameras and the choice of sparse points.

    def __post_init__(self) -> None:
        if not 0.0 <= self.gloss <= 1.0:
            raise InputError(f"--gloss is {self.gloss}; it must lie in [0, 1].")
        if self.seed < 0:
            raise InputError(f"--seed is {self.seed}; it must be at least 0.")

    @property
    def focal_length(self) -> float:
        """Focal length in pixels, the same along x and y; the principal point is the image centre."""
        return 0.5 * self.width / math.tan(0.5 * math.radians(self.field_of_view))
