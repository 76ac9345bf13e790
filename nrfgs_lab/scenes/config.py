# SPDX-License-Identifier: Apache-2.0
"""What can be chosen about a procedural scene."""

import math
from dataclasses import dataclass
from numbers import Integral, Real


@dataclass(frozen=True)
class SceneConfig:
    """One procedural scene and the data set made from it. Equal configs give byte-identical data sets.

    Raises:
        ValueError: naming the field, when a value is outside its range.
    """

    gloss: float = 1.0
    """Weight g of everything specular, in [0, 1]. At 0 each surface point has one colour, whatever the view."""
    mirror: float = 1.0
    """Weight of the mirror's share in what is specular, in [0, 1]. At 0 it is all satin: broad highlights of the lamps,
    and nothing reflected."""
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
        for name, lowest in (("views", 2), ("width", 1), ("height", 1), ("samples", 1), ("points", 1)):
            self._require_integer(name, lowest)
        self._require_integer("test_every", 2)
        self._require_integer("seed", 0)
        for name in ("gloss", "mirror"):
            value = getattr(self, name)
            if not _is_finite(value) or not 0.0 <= value <= 1.0:
                raise ValueError(f"SceneConfig.{name} must lie in [0, 1], got {value!r}")
        if not _is_finite(self.field_of_view) or not 0.0 < self.field_of_view <= 120.0:
            raise ValueError(f"SceneConfig.field_of_view must lie in (0, 120] degrees, got {self.field_of_view!r}")

    def _require_integer(self, name: str, lowest: int) -> None:
        value = getattr(self, name)
        if not isinstance(value, Integral) or isinstance(value, bool) or value < lowest:
            raise ValueError(f"SceneConfig.{name} must be an integer of at least {lowest}, got {value!r}")

    @property
    def focal_length(self) -> float:
        """Focal length in pixels, the same along x and y; the principal point is the image centre."""
        return 0.5 * self.width / math.tan(0.5 * math.radians(self.field_of_view))


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
