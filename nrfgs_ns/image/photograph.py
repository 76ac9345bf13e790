# SPDX-License-Identifier: Apache-2.0
"""What a camera makes of the light before it is a photograph: exposure and white balance.

A scene's colours x are those of its mean look. In a photograph, exposure and white balance multiply the light of each
channel by 2^s, s in stops. Under sRGB's curve above its linear toe that makes of a pixel

    y = k (x + a) - a,    k = 2^(s / GAMMA),    a = TOE,

which is affine in x, and y = x where s = 0.

    exposure        s of each photograph, the same in all channels
    white balance   log2(R/G) and log2(B/G) of each photograph, mean over the channels 0

What all photographs have in common belongs to the scene: both have mean zero over the photographs (`center_`, after
each step), so that the scene, and what is exported of it, has the photographs' mean look. So do patterns over the
photographs that are likelier the scene's than theirs, brightness that changes slowly with the place
(`overlap.estimate`): they stay what they were at the start. All parameters are zero where nothing happens.

The parts are of PPISP (Deutsch et al., arXiv 2601.18336), in the pixels' own space instead of a linear one.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from nrfgs_ns.kernels.trial import Gate

GAMMA = 2.4
"""sRGB's exponent."""
TOE = 0.055
"""sRGB's offset."""
BASIS = ((1.0, 1.0, 1.0), (2 / 3, -1 / 3, -1 / 3), (-1 / 3, -1 / 3, 2 / 3))
"""Stops of red, green and blue for one stop of each number of a photograph: exposure, log2(R/G), log2(B/G)."""
COLUMNS = "exposure", "white-balance", "white-balance"
"""The part that each number belongs to, as version 0.1.0 named them."""


class PhotographModel(nn.Module):
    """What happened to each of P photographs.

    Args:
        names: of the photographs. [P]
        start: stops in red, green and blue to start from; 0 if left out. [P, 3]
        held: for exposure, log2(R/G) and log2(B/G), orthonormal patterns over the photographs that stay as they start,
            the constant among them; the constants alone if left out. [P, K] each
    """

    def __init__(self, names: Sequence[str], start: Tensor | None = None, held: Sequence[Tensor] | None = None):
        super().__init__()
        self.names = list(names)
        basis = torch.tensor(BASIS)
        self.register_buffer("basis", basis, persistent=False)
        self.register_buffer("exponents", (basis.T / GAMMA).contiguous(), persistent=False)
        stops = torch.zeros(len(names), 3) if start is None else start.float()
        self.shots = Parameter((stops - stops.mean(dim=0)) @ torch.linalg.pinv(basis))
        """exposure, log2(R/G) and log2(B/G) of each photograph, stops. [P, 3]"""
        self._hold([self._constant()] * 3 if held is None else [pattern.float() for pattern in held])

    def _hold(self, patterns: Sequence[Tensor]) -> None:
        """Keep patterns over the photographs [P, K], of each column of the exposures, as they are now."""
        rows = self.shots.new_zeros(sum(pattern.shape[1] for pattern in patterns), *self.shots.shape)
        first = 0
        for column, pattern in enumerate(patterns):
            rows[first : first + pattern.shape[1], :, column] = pattern.T
            first += pattern.shape[1]
        self.register_buffer("held", rows.flatten(1).detach())
        self.register_buffer("kept", self.held @ self.shots.detach().flatten())

    def _constant(self) -> Tensor:
        """The pattern that all photographs have in common, [P, 1]."""
        count = len(self.names)
        return self.shots.new_full((count, 1), max(count, 1) ** -0.5).detach()

    def forward(self, image: Tensor, index: int) -> Tensor:
        """A picture of the scene as one photograph has it.

        Args:
            image: [H, W, 3], colours of the mean look; not clamped, so that what is white in one photograph may be
                less than that in another.
            index: of the photograph.

        Returns:
            [H, W, 3] in [0, 1].
        """
        if _kernels_take(image, self.shots):
            from nrfgs_ns.image.photograph_triton import Exposed

            return Exposed.apply(image, self.shots, index, self.exponents)
        return with_gain(image, (self.exponents @ self.shots[index]).exp2()).clamp(0.0, 1.0)

    @torch.no_grad()
    def center_(self) -> None:
        """After a step: take out of exposures and white balances what is the scene's."""
        flat = self.shots.view(-1)
        flat.addmv_(self.held.T, torch.addmv(self.kept, self.held, flat, alpha=-1.0))

    @torch.no_grad()
    def stops(self) -> Tensor:
        """Stops of each photograph in red, green and blue, [P, 3], on the host."""
        return (self.shots @ self.basis).cpu()

    # Checkpoints.

    def get_extra_state(self) -> dict[str, Any]:
        return {"names": self.names}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        if state["names"] != self.names:
            raise ValueError("the checkpoint's photographs are others")

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "PhotographModel":
        """The model that a state_dict was taken from."""
        model = cls(state["_extra_state"]["names"])
        model.load_state_dict(state)
        return model

    @classmethod
    def upgraded(cls, state: Mapping[str, Any]) -> dict[str, Any]:
        """A state_dict as this version writes it, from one that any version wrote: with vignetting and response of each
        camera, too, which the mean look is without; with some numbers of a photograph only; without patterns."""
        extra = state["_extra_state"]
        columns = [column for column, part in enumerate(COLUMNS) if part in extra.get("parts", COLUMNS)]
        model = cls(extra["names"])
        if columns:
            model.shots.data[:, columns] = state["shots"].detach().to(model.shots)
        if len(columns) == len(COLUMNS) and "held" in state:
            model.held, model.kept = state["held"], state["kept"]
        else:
            model._hold([model._constant()] * 3)
        return model.state_dict()

    def _load_from_state_dict(self, state_dict, prefix, *args):
        for name in ("held", "kept"):  # the patterns are the checkpoint's, whatever their number
            if (patterns := state_dict.get(prefix + name)) is not None:
                setattr(self, name, torch.empty_like(patterns, device=self.shots.device))
        super()._load_from_state_dict(state_dict, prefix, *args)


def with_gain(image: Tensor, gain: Tensor) -> Tensor:
    """A picture [H, W, 3] whose light is multiplied by gain^GAMMA under sRGB's curve; gain [3] or [H, W, 3]."""
    return torch.addcmul(gain * TOE - TOE, image, gain)


def exposed(image: Tensor, stops: float | Tensor) -> Tensor:
    """A picture [H, W, 3] exposed by so many stops more, a number or one for each channel [3]; clamped to [0, 1]."""
    gain = torch.exp2(torch.as_tensor(stops, dtype=image.dtype, device=image.device) / GAMMA)
    return with_gain(image, gain).clamp(0.0, 1.0)


MAX_NUMBERS = 2**31
"""The kernels index an image with 32 bits."""
_GATE = Gate("The photographs' exposure")


def _kernels_take(image: Tensor, shots: Tensor) -> bool:
    """Whether the kernels compute this."""
    return (
        image.is_cuda
        and shots.is_cuda
        and image.dtype == shots.dtype == torch.float32
        and 0 < image.numel() < MAX_NUMBERS
        and _GATE.opens(image.device, image.device, lambda: _try_kernels(image.device))
    )


def _try_kernels(device: torch.device) -> None:
    """Compile and run the kernels on one pixel; raise whatever goes wrong."""
    from nrfgs_ns.image.photograph_triton import Exposed

    shots, pixel = (torch.zeros(size, device=device, requires_grad=True) for size in ((1, 3), (1, 1, 3)))
    Exposed.apply(pixel, shots, 0, torch.eye(3, device=device)).sum().backward()
