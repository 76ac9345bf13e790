# SPDX-License-Identifier: Apache-2.0
"""The appearance head: the one seam between a splat's colours and opacity and everything else.

A head defines the numbers that a splat stores (`splat_params`), which densification, optimisers and checkpoints carry
without knowing their meaning; colours and opacities of the splats that a camera sees (`forward`); and their part that
does not depend on the view (`base_appearance`). Shared weights are the head's own parameters.

A field is a head and the table of splats that it colours; in training the head sees the splats under `ViewNoise`.
"""

import math
import os
import traceback
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor, nn

from nrfgs_ns.errors import InputError, require

if TYPE_CHECKING:  # the rasterizer imports this module
    from nrfgs_ns.rasterizer import View

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""
NEAR = 0.01
"""Smallest camera distance, in scene units: the near plane, closer than which nothing is drawn."""


class SplatAppearance(NamedTuple):
    """Colours and opacities of M splats, from one camera position each."""

    colors: Tensor
    """Linear blend colours, [M, 3], >= 0; 1 is white. For a head at the pixel: features, [M, D] with any D."""
    opacities: Tensor
    """Peak opacities, [M], in [0, 1]."""


class Component(NamedTuple):
    """One part of a head's result at M splats, for the viewer."""

    values: Tensor
    """[M, 3] for a change of colour, in units of white; [M, 1] otherwise."""
    kind: Literal["color", "opacity", "weight"]
    """color, opacity: a signed change, 0 where the head changes nothing. weight: a share, in [0, 1]."""


@dataclass
class AppearanceHeadConfig:
    """Base of all heads' configurations."""

    _target: type = field(default_factory=lambda: AppearanceHead)

    def setup(self, scene_unit: float = 1.0) -> "AppearanceHead":
        """Build the head, or raise InputError if a field is out of range; `scene_unit`: world units in a scene unit."""
        self.validate()
        head = self._target(self)
        head.config, head.scene_unit = self, scene_unit
        return head

    def validate(self) -> None:
        """Raise InputError, naming the field and the fix, if a value cannot work."""

    def trusted(self, share: float) -> "AppearanceHeadConfig":
        """The configuration for a capture that supports only a share, in (0, 1], of the view dependence."""
        return self

    def for_copies(self) -> "AppearanceHeadConfig":
        """The configuration where densification replaces a splat by others that share its opacity."""
        return self

    def require(self, holds: bool, name: str, needed: str) -> None:
        """Raise InputError naming field `name`, its value and what is `needed`, unless the condition holds."""
        require(holds, f"pipeline.model.appearance.{name}", repr(getattr(self, name)), needed)


class AppearanceHead(nn.Module, ABC):
    """Maps visible splats and the camera's centre to colours and opacities.

    A splat's base colour is stored as `features_dc` [N, 3], the coefficient of the constant spherical harmonic, as in
    3DGS: colour = 1/2 + SH_C0 * features_dc. Its base opacity is sigmoid(`opacities`), with `opacities` [N, 1].
    """

    name: str
    """Short name, written into checkpoints."""
    config: AppearanceHeadConfig
    """The configuration from which `setup` built the head."""
    sh_degree: int = 0
    """Degree of the spherical harmonics among the splats' parameters; 0 if there are none."""
    scene_unit: float = 1.0
    """World units in a scene unit. A head works in scene units, so that the world's unit does not matter."""
    is_harmonics: bool = False
    """Whether colours are exactly the harmonics in `features_dc` and `features_rest`, and opacities the base's."""
    at_pixel: bool = False
    """Whether `colors` are features [M, D], any D, which `image_of` turns into an image once composited. Such a
    head needs no `features_dc`, its `base_appearance` is in features, too, and rays are the camera's, without noise."""

    def __init__(self, config: AppearanceHeadConfig | None = None):
        super().__init__()  # `setup` gives it the configuration

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """Initial per-splat tensors [N, ...] by name, on rgb's device, for base colours rgb [N, 3] in [0, 1].

        Each name needs an optimiser of the same name in the method's configuration.
        """
        return {"features_dc": (rgb - 0.5) / SH_C0}

    @abstractmethod
    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        """Colours and opacities of the visible splats, seen from their cameras.

        Args:
            splats: the whole table: "means" [N, 3], "opacities" (logits) [N, 1], and this head's `splat_params`.
            visible: rows of the table, int64 [M], camera by camera, each camera's ascending.
            camera_centers: where each visible splat is seen from, in world coordinates: [3] or [M, 3].
        """

    def base_appearance(self, splats: Mapping[str, Tensor], visible: Tensor) -> SplatAppearance:
        """The part of the visible splats' appearance that does not depend on the camera."""
        return SplatAppearance(
            colors=base_colors(splats["features_dc"].index_select(0, visible)).clamp_min(0.0),
            opacities=base_opacities(splats["opacities"].index_select(0, visible)),
        )

    def image_of(self, composited: Tensor, rays: Tensor) -> Tensor:
        """The opaque image [H, W, 3] of a head at the pixel; 1 is white. Other heads' composited colours are the image.

        Args:
            composited: the splats' features, composited over zero, [H, W, D].
            rays: unit directions from the camera through the pixels, in world axes, [H, W, 3].
        """
        return composited

    def require_splat_colors(self) -> None:
        """Raise InputError for a head at the pixel, which no file of splats can hold."""
        if self.at_pixel:
            raise InputError(
                f"The {self.name!r} head colours pixels, by a network that runs after splats are composited: no file "
                "of splats can hold it. Use ns-render, ns-eval or ns-viewer."
            )

    def components(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> dict[str, Component]:
        """Parts of the head's result, for the viewer and for logs; never called in training.

        Each is a mode of the viewer under its name. The names must not depend on the arguments; M = 0 must work.
        "residual" is always there: the colours of `forward` minus those of `base_appearance`. A head at the pixel has
        no components.
        """
        if self.at_pixel:
            return {}
        colors = self(splats, visible, camera_centers).colors
        return {"residual": Component(colors - self.base_appearance(splats, visible).colors, "color")}

    def set_step(self, step: int) -> None:  # noqa: B027  (most heads have no schedule)
        """Set the training step, for heads that grow with training."""

    @property
    def phase(self) -> Hashable:
        """What `set_step` has set: while it stays equal, the head computes the same function."""
        return None

    def try_kernels(self, device: torch.device) -> None:  # noqa: B027  (most heads have none)
        """Try the head's own kernels on a CUDA device, which compiles them before the first step."""

    def neutral_loss(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> Tensor | None:
        """Mean squared residual, a scalar that the warm-up minimises; None for a head that needs no warm-up."""
        return None


class Field(NamedTuple):
    """A head and the table of the N splats that it colours."""

    head: AppearanceHead
    splats: Mapping[str, Tensor]
    """"means", "opacities" and the head's `splat_params`, [N, ...]"""

    def seen_from(self, view: "View") -> SplatAppearance:
        """Colours and opacities of the M splats that a view sees."""
        return self.head(self.splats, view.visible, view.center)

    def base_of(self, view: "View") -> SplatAppearance:
        """The part of `seen_from` that does not depend on the camera."""
        return self.head.base_appearance(self.splats, view.visible)

    def detached(self) -> "Field":
        """The same field without gradients to the table."""
        return Field(self.head, {name: value.detach() for name, value in self.splats.items()})


class ViewNoise:
    """Noise on the camera centre from which the head sees splats in training.

    A head that stores many numbers for each splat can learn every training view by heart, and answers at random between
    them. A capture whose neighbouring cameras are a distance s apart (`data.views.camera_spacing`) says nothing about
    changes over less than s. So in training the head, and it alone, sees each splat i from a camera centre of its own,

        o_i = o + e_i,    e_i ~ N(0, sigma^2 I),    sigma = factor * s / sqrt 3,

    drawn anew in each step: e_i is `factor` * s long in the root mean square. The head then learns the mean over views
    that the capture cannot tell apart. To second order in sigma that is its loss plus sigma^2 / 2 times the square of
    its slope by o (Bishop, Neural Computation 7, 1995), for each splat on its own: it smooths over the angle
    sigma / |o - x|, wide for near splats and narrow for far ones, as are the angles between the capture's cameras.

    For a head that looks along o - x_i, moving the camera centre by e_i is moving the mean by -e_i. So the head is
    given other means, and one camera centre serves all splats.

    The noise depends on the seed and the step alone: a resumed training draws the same as the unbroken one.

    Args:
        length: root mean square, world units; 0 for no noise.
        seed: the training's; devices that hold different splats need different ones.
    """

    def __init__(self, length: float, seed: int):
        self.sigma = length / math.sqrt(3.0)
        self.seed = seed
        self._generators: dict[torch.device, torch.Generator] = {}

    def moved(self, splats: Mapping[str, Tensor], generator: torch.Generator | None) -> Mapping[str, Tensor]:
        """A table as the head sees it in a training step, with other "means" [N, 3]. None: without noise."""
        if generator is None:
            return splats
        means = splats["means"]
        noise = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
        return {**splats, "means": torch.add(means, noise, alpha=self.sigma)}

    def generator(self, device: torch.device, step: int) -> torch.Generator | None:
        """The generator of a step's noise on a device; the same object in each step. None: no noise."""
        if self.sigma == 0.0:
            return None
        if device not in self._generators:
            self._generators[device] = torch.Generator(device)
        # Two odd numbers of 64 bits, so that neighbouring steps and seeds are unrelated.
        key = (self.seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9) % 2**63
        return self._generators[device].manual_seed(key ^ key >> 31)


@contextmanager
def located_errors(config: AppearanceHeadConfig) -> Iterator[None]:
    """Re-raise an exception of a head's code, which may be anybody's, as an InputError that names file and line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        last = [frame for frame in frames if f"{os.sep}torch{os.sep}" not in frame.filename][-1]
        raise InputError(
            f"The head of {type(config).__name__} fails: {type(error).__name__}: {error} ({last.filename}, line "
            f"{last.lineno}). What it stores of a splat, splat_params must return. NRFGS_DEBUG=1 shows the traceback."
        ) from error


@torch.no_grad()
def check_head(head: AppearanceHead, splats: Mapping[str, Tensor]) -> None:
    """Raise InputError where a head breaks its contract, given its initial table. `forward` sees two more rows, copies
    of a splat: a head with a table of its own, which densification could not extend, fails here."""
    where = f"{type(head).__module__}.{type(head).__name__}"
    count = len(splats["means"])

    def check(part: str, value: Tensor, *shape: int) -> None:
        if value.dtype != torch.float32 or value.shape != shape or not value.isfinite().all():
            actual = f"{str(value.dtype).removeprefix('torch.')} {[*value.shape]}"
            actual += "" if value.isfinite().all() else ", not all finite"
            raise InputError(f"{where}: {part} must be finite float32 {[*shape]}, but is {actual}. Correct it there.")

    if not isinstance(getattr(head, "name", None), str):
        raise InputError(f'{where} has no name, which checkpoints need. Give the class one, such as name = "mine".')
    for name, value in splats.items():
        check(f"{name!r} of splat_params", value, count, *value.shape[1:])
    if count == 0:
        return
    table = {name: value[:1].expand(count + 2, *value.shape[1:]).contiguous() for name, value in splats.items()}
    result = head(table, torch.arange(count, count + 2), splats["means"][0] + head.scene_unit)
    if not isinstance(result, SplatAppearance):
        kind = type(result).__name__
        raise InputError(f"{where}: forward returns a {kind}. Let it return SplatAppearance(colors, opacities).")
    check("opacities of forward, for two splats,", result.opacities, 2)
    check("colors of forward, for two splats,", result.colors, 2, result.colors.shape[-1] if head.at_pixel else 3)
    if head.at_pixel:
        features = result.colors[0].repeat(16, 16, 1)
        rays = torch.tensor([0.0, 0.0, 1.0]).repeat(16, 16, 1)
        check("what image_of makes of 16 x 16 pixels", head.image_of(features, rays), 16, 16, 3)


def layers(*widths: int) -> list[nn.Module]:
    """Linear layers between these widths, with leaky ReLUs between them."""
    pairs = [(nn.Linear(*sizes), nn.LeakyReLU()) for sizes in pairwise(widths)]
    return [layer for pair in pairs for layer in pair][:-1]


def base_opacities(logits: Tensor) -> Tensor:
    """Base opacities [M] from stored logits [M, 1]. Select rows first: after the sigmoid the last bit may differ."""
    return torch.sigmoid(logits).squeeze(-1)


def base_colors(features_dc: Tensor) -> Tensor:
    """Base colours [M, 3] from the constant harmonic's coefficients [M, 3]."""
    return 0.5 + SH_C0 * features_dc


def unit_vectors(vectors: Tensor, floor: float) -> Tensor:
    """Vectors v / max(|v|, floor), [..., 3], for finite v and floor > 0; its gradient is at most 1 / floor.

    Spherical harmonics and lobes take the direction from camera to splat, opposite to `nrf.view_geometry`'s.
    """
    return vectors / vectors.square().sum(dim=-1, keepdim=True).clamp_min(floor * floor).sqrt()
