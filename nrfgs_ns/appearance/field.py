# SPDX-License-Identifier: Apache-2.0
"""A field: a head and the table of splats that it draws. What is rendered, exported or made smaller is one."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from torch import Tensor

from nrfgs_ns.appearance.diffuse import DIFFUSE
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
    """"means", "opacities" and the head's `splat_params`, [N, ...]; with "diffuse" (`diffuse.py`) if it is known which
    are"""

    def seen_from(self, view: Sight) -> SplatAppearance:
        """Colours and opacities of the M splats that a view sees."""
        return self.head(self.splats, view.visible, view.center)

    def base_of(self, view: Sight) -> SplatAppearance:
        """The part of them that does not depend on the camera."""
        return self.head.base_appearance(self.splats, view.visible)

    def components_of(self, view: Sight) -> dict[str, Component]:
        """What the head's answer is made of (`AppearanceHead.components`)."""
        return self.head.components(self.splats, view.visible, view.center)

    def detached(self) -> "Field":
        """The same without gradients to the table."""
        return Field(self.head, {name: value.detach() for name, value in self.splats.items()})

    @property
    def bytes(self) -> int:
        """Bytes that a renderer needs in float32: of diffuse splats not what only a residual reads, and a bit each that
        says so."""
        size = sum(weight.numel() * weight.element_size() for weight in self.head.parameters())
        diffuse = self.splats.get(DIFFUSE)
        for name, value in self.splats.items():
            if name == DIFFUSE:
                size += -(-len(value) // 8)
            else:
                left_out = diffuse is not None and name in self.head.residual_params
                rows = int((~diffuse).sum()) if left_out else len(value)
                size += rows * value[:1].numel() * value.element_size()
        return size
