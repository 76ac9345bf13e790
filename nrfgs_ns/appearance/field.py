# SPDX-License-Identifier: Apache-2.0
"""A field: a head and the table of splats that it draws."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from torch import Tensor

from nrfgs_ns.appearance.head import AppearanceHead, Component, SplatAppearance


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
    """"means", "opacities" and the head's `splat_params`, [N, ...]"""

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
        """Bytes that a renderer needs."""
        return sum(value.nbytes for value in (*self.head.parameters(), *self.splats.values()))
