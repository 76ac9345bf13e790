# SPDX-License-Identifier: Apache-2.0
"""What nerfstudio's exporter and viewer read of a model: splats with spherical harmonics, whatever its head is.

The viewer reads all of it, often. Only where `fit_on` was called, as neither a training nor a viewer does, are colours
and opacities those of harmonics fitted to the head (`harmonics_fit.py`).
"""

from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.model.harmonics_fit import DEGREE, Fit, fit_harmonics


class ExportedTables:
    """The part of `NrfgsModel` that others read splats from; it needs the rest, its `gauss_params` above all."""

    _fit_cameras: Cameras | None = None
    _fit: Fit | None = None

    def fit_on(self, cameras: Cameras) -> None:
        """Let the properties below be fitted harmonics from now on, as seen from these cameras [V].

        The fit is made when one of them is first read, and kept until a checkpoint is loaded.
        """
        self._fit_cameras, self._fit = cameras, None
        self.config.sh_degree = DEGREE

    @property
    def fit(self) -> Fit | None:
        """The fitted harmonics, or None where `fit_on` was not called."""
        if self._fit is None and self._fit_cameras is not None:
            self._fit = fit_harmonics(self, self._fit_cameras)
        return self._fit

    def _exported(self, name: str) -> Tensor:
        """A table of the splats: the fit's if there is one, else the stored one."""
        fit = self.fit
        return self.gauss_params[name] if fit is None else getattr(fit.splats, name)

    @property
    def colors(self) -> Tensor:
        """Base colours [N, 3]."""
        return base_colors(self.shs_0)

    @property
    def opacities(self) -> Tensor:
        """Opacities' logits [N, 1]."""
        return self._exported("opacities")

    @property
    def quats(self) -> Tensor:
        """Rotations (w, x, y, z) [N, 4]; of unit length if fitted."""
        return self._exported("quats")

    @property
    def shs_0(self) -> Tensor:
        """Coefficients of the constant harmonic [N, 3]."""
        return self._exported("features_dc")

    @property
    def shs_rest(self) -> Tensor:
        """Coefficients of the higher harmonics [N, B, 3]; B = 0 for a head without any, unless they are fitted."""
        return self.features_rest if self.fit is None else self.fit.splats.features_rest

    @property
    def features_rest(self) -> Tensor:
        """The stored coefficients of the higher harmonics [N, B, 3]; B = 0 for a head without any."""
        if "features_rest" in self.gauss_params:
            return self.gauss_params["features_rest"]
        return self.features_dc.new_zeros(self.num_points, 0, 3)

    def forget_fit(self) -> None:
        """Let the fit, if there is one, be made anew: the splats have changed."""
        self._fit = None
