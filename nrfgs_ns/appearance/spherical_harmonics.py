# SPDX-License-Identifier: Apache-2.0
"""Real spherical harmonics of any degree, in the order and with the signs that 3DGS uses.

With unit direction (x, y, z), order m and degree l,

    Y_{l, m} = (-1)^m q_{l, m}(z) C_m(x, y)   for m >= 0,        Y_{l, -m} = (-1)^m q_{l, m}(z) S_m(x, y)   for m > 0,

where C_m + i S_m = (x + i y)^m and q_{l, m} is the normalised associated Legendre polynomial without its factor
(1 - z^2)^(m/2), which C_m and S_m carry. Both come from short recurrences (P.-P. Sloan, "Efficient Spherical Harmonic
Evaluation", JCGT 2(2), 2013):

    q_{0, 0} = 1 / sqrt(4 pi)
    q_{m, m} = q_{m-1, m-1} sqrt((2 m + 1) / (2 m)), times sqrt(2) once on the way from m = 0 to m = 1
    q_{l, m} = a_{l, m} (z q_{l-1, m} - q_{l-2, m} / a_{l-1, m}),     a_{l, m} = sqrt((4 l^2 - 1) / (l^2 - m^2))
"""

import math

import torch
from torch import Tensor

from nrfgs_ns.kernels.trial import Gate


def num_bases(degree: int) -> int:
    """Harmonics of degree 0..degree."""
    return (degree + 1) ** 2


def sh_bases(degree: int, directions: Tensor) -> Tensor:
    """Harmonics at unit directions.

    Args:
        degree: highest degree, >= 0.
        directions: unit vectors [M, 3].

    Returns:
        [M, (degree + 1)^2], harmonic (l, m) at index l (l + 1) + m.
    """
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
                step_back = 1.0 / _recurrence(degree_l - 1, m) if degree_l - 1 > m else 0.0
                before, q = q, _recurrence(degree_l, m) * (z * q - step_back * before)
            bases[degree_l, m] = q * cos_m
            if m > 0:
                bases[degree_l, -m] = q * sin_m
    return torch.stack([bases[lm] for lm in sorted(bases)], dim=-1)


def eval_sh(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """Sum of harmonics up to `degree`.

    On CUDA this is a kernel, `harmonics_triton.py`'s or, where Triton does not run, gsplat's; elsewhere the twin above.

    Args:
        degree: highest degree used; coefficients beyond it are ignored.
        directions: [M, 3], any length but zero.
        coefficients: [M, B, 3] with B >= (degree + 1)^2.

    Returns:
        [M, 3].

    Raises:
        RuntimeError: a CUDA graph is being recorded, and gsplat's kernel, which it would miss, is all there is.
    """
    if directions.is_cuda:
        if (
            directions.dtype == coefficients.dtype == torch.float32
            and degree <= 3
            and kernels_run_on(directions.device)
        ):
            from nrfgs_ns.appearance.harmonics_triton import Harmonics

            return Harmonics.apply(degree, directions, coefficients)
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError("gsplat's spherical harmonics cannot be recorded")
        from gsplat import spherical_harmonics  # its kernels are compiled at the first call

        return spherical_harmonics(degree, directions, coefficients)
    bases = sh_bases(degree, torch.nn.functional.normalize(directions, dim=-1))
    return torch.einsum("mb,mbc->mc", bases, coefficients[:, : num_bases(degree)])


_GATE = Gate("Spherical harmonics")


def kernels_run_on(device: torch.device) -> bool:
    """Whether Triton's kernels run on a CUDA device; tried once, which compiles them."""
    return _GATE.opens(device, device, lambda: _try_kernels(device))


def _try_kernels(device: torch.device) -> None:
    """Compile and run both kernels on one splat, at each degree; raise whatever goes wrong."""
    from nrfgs_ns.appearance.harmonics_triton import MAX_DEGREE, Harmonics

    direction = torch.ones(1, 3, device=device, requires_grad=True)
    for degree in range(MAX_DEGREE + 1):
        coefficients = torch.ones(1, num_bases(MAX_DEGREE), 3, device=device, requires_grad=True)
        Harmonics.apply(degree, direction, coefficients).sum().backward()


def _recurrence(degree_l: int, m: int) -> float:
    """a_{l, m} of the module's docstring, for l > m."""
    return math.sqrt((4.0 * degree_l**2 - 1.0) / (degree_l**2 - m**2))
