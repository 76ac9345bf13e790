# SPDX-License-Identifier: Apache-2.0
"""Spherical harmonics: the colour model of 3DGS.

    colour = max(0, 1/2 + sum_{l <= L} sum_m k_{l, m} Y_{l, m}(d)),    d from the camera to the splat,

with L growing by one every `degree_interval` steps up to `degree`. Opacity does not depend on the view. The harmonics
are real, in 3DGS's order and with its signs. With d = (x, y, z), order m and degree l,

    Y_{l, m} = (-1)^m q_{l, m}(z) C_m(x, y)   for m >= 0,        Y_{l, -m} = (-1)^m q_{l, m}(z) S_m(x, y)   for m > 0,

where C_m + i S_m = (x + i y)^m and q_{l, m} is the normalised associated Legendre polynomial without its factor
(1 - z^2)^(m/2), which C_m and S_m carry (P.-P. Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2(2), 2013):

    q_{0, 0} = 1 / sqrt(4 pi)
    q_{m, m} = q_{m-1, m-1} sqrt((2 m + 1) / (2 m)), times sqrt(2) once on the way from m = 0 to m = 1
    q_{l, m} = a_{l, m} (z q_{l-1, m} - q_{l-2, m} / a_{l-1, m}),     a_{l, m} = sqrt((4 l^2 - 1) / (l^2 - m^2))
"""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import AppearanceHead, AppearanceHeadConfig, SplatAppearance, base_opacities
from nrfgs_ns.kernels.trial import tried_once


@dataclass
class ShConfig(AppearanceHeadConfig):
    """Spherical harmonics, as in splatfacto."""

    _target: type = field(default_factory=lambda: SphericalHarmonics)
    degree: int = 3
    """highest degree, 0 to 3. 0 is a colour that does not depend on the view."""
    degree_interval: int = 1000
    """training steps after which the next degree is switched on."""

    def validate(self) -> None:
        self.require(0 <= self.degree <= 3, "degree", "0, 1, 2 or 3")
        self.require(self.degree_interval >= 1, "degree_interval", "at least 1")


class SphericalHarmonics(AppearanceHead):
    """Colours from harmonics, opacities from the base."""

    name = "sh"
    is_harmonics = True

    def __init__(self, config: ShConfig):
        super().__init__()
        self.sh_degree = self.active_degree = config.degree

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """Coefficients: "features_dc" [N, 3], and the higher degrees' "features_rest" [N, (degree + 1)^2 - 1, 3]."""
        rest = torch.zeros(len(rgb), num_bases(self.config.degree) - 1, 3, device=rgb.device)
        return {**super().splat_params(rgb), "features_rest": rest}

    def try_kernels(self, device: torch.device) -> None:
        kernels_run_on(device)

    def set_step(self, step: int) -> None:
        self.active_degree = min(step // self.config.degree_interval, self.config.degree)

    @property
    def phase(self) -> Hashable:
        return self.active_degree

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        means, coefficients, opacities = self.rows(splats, visible, camera_centers)
        colors = eval_sh(self.active_degree, means - camera_centers, coefficients) + 0.5
        return SplatAppearance(colors.clamp_min(0.0), opacities)

    def rows(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> tuple[Tensor, ...]:
        """Means [M, 3], coefficients [M, (degree + 1)^2, 3] and base opacities [M] of the visible splats."""
        tables = [splats[name] for name in ("means", "features_dc", "features_rest", "opacities")]
        # One camera's rows ascend: N of them are the table, which need not be copied.
        if camera_centers.dim() > 1 or len(visible) < len(tables[0]):
            tables = [table.index_select(0, visible) for table in tables]
        means, constant, rest, logits = tables
        return means, torch.cat([constant[:, None], rest], dim=1), base_opacities(logits)


def num_bases(degree: int) -> int:
    """Number of harmonics of degrees 0..degree."""
    return (degree + 1) ** 2


def sh_bases(degree: int, directions: Tensor) -> Tensor:
    """Harmonics at unit directions [M, 3]: [M, (degree + 1)^2], harmonic (l, m) at index l (l + 1) + m."""

    def a(degree_l: int, m: int) -> float:
        return math.sqrt((4.0 * degree_l**2 - 1.0) / (degree_l**2 - m**2))

    x, y, z = directions.unbind(-1)
    bases: dict[tuple[int, int], Tensor] = {}
    cos_m, sin_m = torch.ones_like(z), torch.zeros_like(z)  # C_m and S_m
    q_mm = 1.0 / math.sqrt(4.0 * math.pi)
    for m in range(degree + 1):
        if m > 0:
            cos_m, sin_m = x * cos_m - y * sin_m, x * sin_m + y * cos_m
            q_mm *= -math.sqrt((2 * m + 1) / (2 * m)) * (math.sqrt(2.0) if m == 1 else 1.0)
        before, q = torch.zeros_like(z), torch.full_like(z, q_mm)
        for degree_l in range(m, degree + 1):
            if degree_l > m:
                step_back = 1.0 / a(degree_l - 1, m) if degree_l - 1 > m else 0.0
                before, q = q, a(degree_l, m) * (z * q - step_back * before)
            bases[degree_l, m] = q * cos_m
            if m > 0:
                bases[degree_l, -m] = q * sin_m
    return torch.stack([bases[lm] for lm in sorted(bases)], dim=-1)


def eval_sh(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """Sum of harmonics up to `degree`, [M, 3]: on CUDA by `harmonics_triton.py`, if Triton runs.

    Args:
        degree: highest degree used; coefficients beyond it are ignored.
        directions: [M, 3], any length but zero.
        coefficients: [M, B, 3] with B >= (degree + 1)^2.
    """
    float32 = directions.dtype == coefficients.dtype == torch.float32
    if directions.is_cuda and float32 and kernels_run_on(directions.device):
        from nrfgs_ns.appearance.harmonics_triton import Harmonics

        return Harmonics.apply(degree, directions, coefficients)
    bases = sh_bases(degree, torch.nn.functional.normalize(directions, dim=-1))
    return torch.einsum("mb,mbc->mc", bases, coefficients[:, : num_bases(degree)])


@tried_once("Spherical harmonics")
def kernels_run_on(device: torch.device) -> bool:
    """Whether Triton's kernels run on a CUDA device."""
    from nrfgs_ns.appearance.harmonics_triton import Harmonics

    direction = torch.ones(1, 3, device=device, requires_grad=True)
    coefficients = torch.ones(1, 16, 3, device=device, requires_grad=True)
    for degree in range(4):
        Harmonics.apply(degree, direction, coefficients).sum().backward()
    return True
