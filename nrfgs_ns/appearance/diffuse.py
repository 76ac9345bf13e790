# SPDX-License-Identifier: Apache-2.0
"""Splats without a residual: the head is evaluated for the others only.

A table of splats may have the entry "diffuse", bool [N]. A diffuse splat has its base colour and base opacity from
everywhere, whatever its other numbers are. The entry is no parameter: nothing learns it, and heads that do not know it
never see it.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import Component, SplatAppearance

DIFFUSE = "diffuse"
"""Name of the table's entry."""


class Others:
    """The visible splats that are not diffuse, for heads in PyTorch: finding them waits for the device. The fused field
    is told the mask instead.

    Args:
        splats, visible, camera_centers: as for `AppearanceHead.forward`, with "diffuse" among the splats.

    Attributes:
        arguments: the same three for the others alone, without the entry.
    """

    def __init__(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor):
        self.count = len(visible)
        self.rows = (~splats[DIFFUSE].index_select(0, visible)).nonzero()[:, 0]
        centers = camera_centers if camera_centers.dim() == 1 else camera_centers.index_select(0, self.rows)
        table = {name: value for name, value in splats.items() if name != DIFFUSE}
        self.arguments = table, visible.index_select(0, self.rows), centers

    def over(self, base: SplatAppearance, appearance: SplatAppearance) -> SplatAppearance:
        """The base appearance of all M visible splats, with the others' appearance put in."""
        return SplatAppearance(
            colors=base.colors.index_copy(0, self.rows, appearance.colors.to(base.colors.dtype)),
            opacities=base.opacities.index_copy(0, self.rows, appearance.opacities.to(base.opacities.dtype)),
        )

    def spread(self, components: Mapping[str, Component]) -> dict[str, Component]:
        """Components of all M visible splats: zeros where there is no residual."""
        spread = {}
        for name, (values, kind) in components.items():
            whole = torch.zeros(self.count, *values.shape[1:], dtype=values.dtype, device=values.device)
            spread[name] = Component(whole.index_copy(0, self.rows, values), kind)
        return spread
