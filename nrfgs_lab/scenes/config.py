# SPDX-License-Identifier: Apache-2.0
"""What can be chosen about a procedural scene."""

import math
from dataclasses import dataclass
from numbers import Real


@dataclass(frozen=True)
class SceneConfig:
    """One procedural scene and the data set made from it. Equal configs give byte-identical data sets.

    Raises:
        ValueError: naming the field, when a value is outside its range.
    """

    gloss: float = 1.0
    """Weight g of everything specular, in [0, 1]. At 0 each surface point has one colour, whatever the view."""
    studio: bool = False
    """A dozen lamps, one satin finish on all objects and no mirrors: small highlights, and nothing else reflected."""
    arc: float = 360.0
    """Range of the cameras' azimuths, degrees, in (0, 360]."""
    views: int = 48
    """Number of images, at least 2."""
    width: int = 200
    """Image width, pixels."""
    height: int = 150
    """Image height, pixels."""
    samples: int = 2
    """Rays per pixel side: a pixel is the mean of samples x samples rays on a regular grid."""
    field_of_view: float = 50.0
    """Horizontal field of view, degrees, in (0, 120]."""
    points: int = 5000
    """Surface points in the sparse point cloud."""
    test_every: int = 8
    """Every test_every-th image by name (0, n, 2n, ...) is a test image; at least 2, so that some image trains."""
    seed: int = 0
    """Decides the noise in the textures, the jitter of the cameras and the choice of sparse points."""

    def __post_init__(self) -> None:
        lowest = {"views": 2, "width": 1, "height": 1, "samples": 1, "points": 1, "test_every": 2, "seed": 0}
        for name, low in lowest.items():
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < low:
                raise ValueError(f"SceneConfig.{name} must be an integer of at least {low}, got {value!r}")
        if not isinstance(self.gloss, Real) or not 0.0 <= self.gloss <= 1.0:
            raise ValueError(f"SceneConfig.gloss must lie in [0, 1], got {self.gloss!r}")
        for name, high in (("field_of_view", 120), ("arc", 360)):
            value = getattr(self, name)
            if not isinstance(value, Real) or not 0.0 < value <= high:
                raise ValueError(f"SceneConfig.{name} must lie in (0, {high}] degrees, got {value!r}")

    @property
    def focal_length(self) -> float:
        """Focal length in pixels, the same along x and y; the principal point is the image centre."""
        return 0.5 * self.width / math.tan(0.5 * math.radians(self.field_of_view))
