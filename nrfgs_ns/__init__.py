# SPDX-License-Identifier: Apache-2.0
"""NRF-GS for nerfstudio: Gaussian splatting with a neural residual field instead of spherical harmonics.

A splat's colour and opacity, seen from a camera, come from an appearance head; everything else is splatfacto.
"""

__version__ = "0.2.0"
