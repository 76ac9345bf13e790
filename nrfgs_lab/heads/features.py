# SPDX-License-Identifier: Apache-2.0
"""What heads at the pixel have in common: features for each splat, which start at random, and base opacities."""

from collections.abc import Mapping

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import AppearanceHead, SplatAppearance, base_opacities


class FeatureHead(AppearanceHead):
    """Features "features" [N, F] for each splat, F >= 3."""

    at_pixel = True
    stored: int
    """F: numbers of a splat"""

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """Features drawn evenly from [0, 1], as in Neural Harmonic Textures; the first three are the point's colour."""
        return {"features": torch.cat([rgb, torch.rand(len(rgb), self.stored - 3, device=rgb.device)], dim=1)}

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        opacities = base_opacities(splats["opacities"].index_select(0, visible))
        return SplatAppearance(self.seen(splats, visible, camera_centers), opacities)

    def base_appearance(self, splats: Mapping[str, Tensor], visible: Tensor) -> SplatAppearance:
        opacities = base_opacities(splats["opacities"].index_select(0, visible))
        return SplatAppearance(self.seen(splats, visible, None), opacities)

    def seen(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor | None) -> Tensor:
        """The features of the visible splats that are composited, [M, D]; without what depends on the view for None."""
        raise NotImplementedError
