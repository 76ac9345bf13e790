# SPDX-License-Identifier: Apache-2.0
"""The splats that nerfstudio's exporter reads, as harmonics, from the model's properties."""

from collections.abc import Callable
from functools import cache

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor

from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.model.harmonics_fit import DEGREE, Fit, fit_harmonics
from nrfgs_ns.model.harmonics_tune import fine_tune


class ExportedModel(SplatfactoModel):
    """Splatfacto whose splats are the stored ones, or, after `fit_on`, which neither a training nor a viewer calls,
    harmonics fitted to the head (`harmonics_fit.py`)."""

    _fit: Callable[[], Fit] | None = None

    def fit_on(self, cameras: Cameras, steps: int | None = None) -> None:
        """Fit harmonics over these cameras [V] once one of the properties below is read.

        Args:
            steps: of fine-tuning (`harmonics_tune.py`); None: as the device allows.
        """

        @cache
        def fitted() -> Fit:
            fit = fit_harmonics(self, cameras)
            return fit if fit.exact else fit._replace(splats=fine_tune(self, fit.splats, cameras, steps))

        self._fit = fitted
        self.config.sh_degree = DEGREE

    @property
    def fit(self) -> Fit | None:
        """The fitted harmonics; None without `fit_on`."""
        return None if self._fit is None else self._fit()

    def _exported(self, name: str, *missing: int) -> Tensor:
        """A splat's numbers as a file has them; of a head without them zeros [N, *missing]."""
        if self.fit is not None:
            return getattr(self.fit.splats, name)
        stored = self.gauss_params.get(name)
        return self.means.new_zeros(self.num_points, *missing) if stored is None else stored

    opacities = property(lambda self: self._exported("opacities"))
    quats = property(lambda self: self._exported("quats"))
    features_dc = property(lambda self: self._exported("features_dc", 3))
    """coefficients of the constant harmonic [N, 3]; of a head without them zeros, mid grey"""
    features_rest = property(lambda self: self._exported("features_rest", 0, 3))
    """coefficients of the higher harmonics [N, B, 3]; B = 0 for a head without any, unless they are fitted"""
    colors = property(lambda self: base_colors(self.features_dc))
    shs_0 = property(lambda self: self.features_dc)
