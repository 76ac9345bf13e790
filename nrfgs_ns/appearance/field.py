# SPDX-License-Identifier: Apache-2.0
"""A field: a head and the table of splats that it draws, some of which may be diffuse.

A table may have the entry "diffuse", bool [N]. A diffuse splat has its base colour and base opacity from everywhere,
whatever its other numbers are. The entry is no parameter; only the neural residual field knows it.
"""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from torch import Tensor

from nrfgs_ns.appearance.head import AppearanceHead, Component, SplatAppearance

DIFFUSE = "diffuse"
"""Name of the table's entry."""


class Sight(Protocol):
    """Which splats are seen, and from where."""

    @property
    def visible(self) -> Tensor:
        """Rows of the table, int64 [M]; a row occurs once for each camera that sees the splat."""

    @property
    def center(self) -> Tensor:
        """Camera centres in world coordinates, [3] or [M, 3]."""


class Field(NamedTuple):
    """A head and the table of the splats that it draws."""

    head: AppearanceHead
    splats: Mapping[str, Tensor]
    """"means", "opacities" and the head's `splat_params`, [N, ...]; "diffuse", if some are"""

    def seen_from(self, view: Sight) -> SplatAppearance:
        """Colours and opacities of the M splats that a view sees."""
        return self.head(self.splats, view.visible, view.center)

    def base_of(self, view: Sight) -> SplatAppearance:
        """Their part that does not depend on the camera."""
        return self.head.base_appearance(self.splats, view.visible)

    def components_of(self, view: Sight) -> dict[str, Component]:
        """Parts of the head's result (`AppearanceHead.components`)."""
        return self.head.components(self.splats, view.visible, view.center)

    def detached(self) -> "Field":
        """The same without gradients to the table."""
        return Field(self.head, {name: value.detach() for name, value in self.splats.items()})

    @property
    def bytes(self) -> int:
        """Bytes that a renderer needs in float32; diffuse splats need a bit, and no residual's parameters."""
        size = sum(weight.nbytes for weight in self.head.parameters())
        diffuse = self.splats.get(DIFFUSE)
        for name, value in self.splats.items():
            if name == DIFFUSE:
                size += -(-len(value) // 8)
            elif diffuse is not None and name in self.head.residual_params:
                size += value[~diffuse].nbytes
            else:
                size += value.nbytes
        return size


def view_dependent(
    splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor
) -> tuple[Tensor, tuple[Mapping[str, Tensor], Tensor, Tensor]]:
    """The visible splats that are not diffuse, for heads in PyTorch; finding them waits for the device.

    Args:
        splats, visible, camera_centers: as for `AppearanceHead.forward`, with "diffuse" among the splats.

    Returns:
        their indices among the M visible, and the three arguments for them alone, without the entry.
    """
    indices = (~splats[DIFFUSE].index_select(0, visible)).nonzero()[:, 0]
    centers = camera_centers if camera_centers.dim() == 1 else camera_centers.index_select(0, indices)
    table = {name: value for name, value in splats.items() if name != DIFFUSE}
    return indices, (table, visible.index_select(0, indices), centers)
