# SPDX-License-Identifier: Apache-2.0
"""What a camera makes of the light before it is a photograph: exposure, white balance, vignetting, response curve.

A scene's colours x are those of its mean look. In a photograph, exposure and white balance multiply the light of each
channel by 2^s, s in stops, and the lens darkens its corners. The camera's response curve says what that does to a
pixel:

    light      t(x) = (x + a) / (1 - c x),  to the power GAMMA        a: toe, c: shoulder (Naka and Rushton, 1966)
    pixel      y = (k t - a) / (1 + c k t),  k = 2^(s / GAMMA)

With a = 0.055 and c = 0 that is sRGB's curve above its linear toe, and k t - a is affine in x. Whatever the curve is,
y = x where s = 0: the curve only says how a stop acts, unless there are several cameras, of which each has a curve of
its own and the mean of all is the scene's.

    exposure        s of each photograph, the same in all channels
    white balance   log2(R/G) and log2(B/G) of each photograph, mean over the channels 0
    vignetting      of each camera: s falls by v1 r^2 + v2 r^4, v >= 0, r = 1 in the corners
    response        of each camera: a and c

What all photographs have in common belongs to the scene: exposure and white balance have mean zero over the
photographs (`center_`, after each step), so that the scene, and what is exported of it, has the photographs' mean look.
So do patterns over the photographs that are likelier the scene's than theirs, brightness that changes slowly with the
place (`overlap.estimate`): they stay what they were at the start. All parameters are zero where nothing happens.

The parts are those of PPISP (Deutsch et al., arXiv 2601.18336), in the pixels' own space instead of a linear one.
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from nrfgs_ns.kernels.trial import Gate

Part = Literal["exposure", "white-balance", "vignetting", "response"]
PARTS: tuple[Part, ...] = get_args(Part)

GAMMA = 2.4
"""sRGB's exponent."""
TOE = 0.055
"""sRGB's offset."""
LARGEST_TOE, LARGEST_SHOULDER = 0.3, 0.9
SMALLEST_DENOMINATOR = 0.1
"""Of the response curve, which colours far above white would take through zero."""
BASIS = {
    "exposure": ((1.0, 1.0, 1.0),),
    "white-balance": ((2 / 3, -1 / 3, -1 / 3), (-1 / 3, -1 / 3, 2 / 3)),
}
"""Stops of red, green and blue for one stop of each number of a photograph."""
COLUMNS = "exposure", "white-balance", "white-balance"
"""The parts whose numbers they are: exposure, log2(R/G), log2(B/G)."""
TOE_STEP = 0.05
"""The toe's unit where it is learnt."""
PENALTY = 0.01
"""Weight of the squared numbers of a camera in the loss."""


class PhotographModel(nn.Module):
    """What happened to each of P photographs, taken by C cameras.

    Args:
        names: of the photographs. [P]
        camera_of: which camera took each. [P]
        lenses: of each camera: principal point x and y, and focal length x and y, as shares of width and height. [C, 4]
        parts: which of PARTS there are.
        start: stops in red, green and blue to start from; 0 if left out. [P, 3]
        held: for exposure, log2(R/G) and log2(B/G), orthonormal patterns over the photographs that stay as they start,
            the constant among them; the constants alone if left out. [P, K] each

    Raises:
        ValueError: a part is unknown, or shapes do not fit.
    """

    def __init__(
        self,
        names: Sequence[str],
        camera_of: Sequence[int],
        lenses: Tensor,
        parts: Sequence[Part] = ("exposure", "white-balance"),
        start: Tensor | None = None,
        held: Sequence[Tensor] | None = None,
    ):
        super().__init__()
        if unknown := set(parts) - set(PARTS):
            raise ValueError(f"{sorted(unknown)} are no parts of a photograph; there are {', '.join(PARTS)}.")
        if len(names) != len(camera_of) or max(camera_of, default=-1) >= len(lenses):
            raise ValueError(f"{len(names)} names, {len(camera_of)} cameras' numbers and {len(lenses)} cameras.")
        self.names, self.parts = list(names), tuple(part for part in PARTS if part in parts)
        cameras = torch.tensor(list(camera_of), dtype=torch.int64)
        share = torch.bincount(cameras, minlength=len(lenses)).float() / max(len(names), 1)
        self.camera_of = cameras.tolist()  # known to the host: asking a GPU would wait for it
        self.register_buffer("lenses", lenses.float().clone())
        self.register_buffer("share", share[:, None], persistent=False)
        self.falloff = Parameter(torch.zeros(len(lenses), 2)) if "vignetting" in parts else None
        self.curves = Parameter(torch.zeros(len(lenses), 2)) if "response" in parts else None
        self.shots = None
        if rows := [row for part in self.parts for row in BASIS.get(part, ())]:
            basis = torch.tensor(rows)
            self.register_buffer("basis", basis, persistent=False)
            self.register_buffer("exponents", (basis.T / GAMMA).contiguous(), persistent=False)
            stops = torch.zeros(len(names), 3) if start is None else start.float()
            self.shots = Parameter((stops - stops.mean(dim=0)) @ torch.linalg.pinv(basis))
            columns = [column for column, part in enumerate(COLUMNS) if part in parts]
            self._hold([self._constant() if held is None else held[column].float() for column in columns])
        self._radii: dict[tuple[int, int, int], Tensor] = {}

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

    # What a picture becomes.

    def forward(self, image: Tensor, index: int) -> Tensor:
        """A picture of the scene as one photograph has it.

        Args:
            image: [H, W, 3], colours of the mean look; not clamped, so that what is white in one photograph may be
                less than that in another.
            index: of the photograph.

        Returns:
            [H, W, 3] in [0, 1].
        """
        camera = self.camera_of[index]
        if self.falloff is None and self.curves is None:
            if self.shots is None:
                return image.clamp(0.0, 1.0)
            if _kernels_take(image, self.shots):
                from nrfgs_ns.image.photograph_triton import Exposed

                return Exposed.apply(image, self.shots, index, self.exponents)
            return with_gain(image, (self.exponents @ self.shots[index]).exp2()).clamp(0.0, 1.0)
        stops = image.new_zeros(3) if self.shots is None else self.shots[index] @ self.basis
        return self._taken(image, stops, camera)

    def by_camera(self, image: Tensor, camera: int) -> Tensor:
        """A picture [H, W, 3] of the mean look as a camera would have taken it: its vignetting and response alone; in
        [0, 1]."""
        if self.falloff is None and self.curves is None:
            return image.clamp(0.0, 1.0)
        return self._taken(image, image.new_zeros(3), camera)

    def _taken(self, image: Tensor, stops: Tensor, camera: int) -> Tensor:
        if self.falloff is not None:
            squared = self._squared_radius(*image.shape[:2], camera)
            stops = stops - squared * (self.falloff[camera, 0] + self.falloff[camera, 1] * squared)
        gain = torch.exp2(stops / GAMMA)
        if self.curves is None:
            return with_gain(image, gain).clamp(0.0, 1.0)
        curves = self.curves * self.curves.new_tensor([TOE_STEP, 1.0]) + self.curves.new_tensor([TOE, 0.0])
        mean_toe, mean_shoulder = (self.share * curves).sum(0)
        toe, shoulder = curves[camera]
        above = image * (gain + toe * mean_shoulder) + (gain * mean_toe - toe)
        below = 1.0 + shoulder * gain * mean_toe + image * (shoulder * gain - mean_shoulder)
        return (above / below.clamp_min(SMALLEST_DENOMINATOR)).clamp(0.0, 1.0)

    def _squared_radius(self, height: int, width: int, camera: int) -> Tensor:
        """Squared distance from the principal point in half diagonals, [H, W, 1]."""
        key = (height, width, camera)
        if key not in self._radii:
            with torch.inference_mode(False), torch.no_grad():
                x, y = self.lenses[camera, :2] * self.lenses.new_tensor([width, height])
                across = torch.arange(width, dtype=x.dtype, device=x.device) + 0.5 - x
                down = torch.arange(height, dtype=y.dtype, device=y.device) + 0.5 - y
                diagonal = (width / 2) ** 2 + (height / 2) ** 2
                self._radii[key] = ((across.square() + down.square()[:, None]) / diagonal)[..., None]
        return self._radii[key]

    # What is learnt.

    def penalty(self, index: int) -> Tensor:
        """What the numbers of a photograph's camera cost in the loss, a scalar: nothing for what does nothing.

        Exposure and white balance cost nothing: pictures say what is not held.
        """
        camera = self.camera_of[index]
        numbers = [table[camera] for table in (self.falloff, self.curves) if table is not None]
        own = numbers[0] if len(numbers) == 1 else torch.cat(numbers)
        return PENALTY * torch.dot(own, own)

    @property
    def has_penalty(self) -> bool:
        """Whether there is anything that costs."""
        return self.falloff is not None or self.curves is not None

    @torch.no_grad()
    def center_(self) -> None:
        """After a step: take out of exposures and white balances what is the scene's, and keep within bounds."""
        if self.shots is not None:
            flat = self.shots.view(-1)
            flat.addmv_(self.held.T, torch.addmv(self.kept, self.held, flat, alpha=-1.0))
        if self.falloff is not None:
            self.falloff.clamp_(min=0.0)
        if self.curves is not None:
            self.curves[:, 0].clamp_(-TOE / TOE_STEP, (LARGEST_TOE - TOE) / TOE_STEP)
            self.curves[:, 1].clamp_(0.0, LARGEST_SHOULDER)

    @torch.no_grad()
    def stops(self) -> Tensor:
        """Stops of each photograph in red, green and blue, [P, 3], on the host."""
        return torch.zeros(len(self.names), 3) if self.shots is None else (self.shots @ self.basis).cpu()

    def camera_like(self, width: float, height: float, fx: float, fy: float) -> int:
        """Which of the cameras has the field of view that is nearest to another's (focal lengths and sizes: pixels)."""
        angle = self.lenses.new_tensor([fx / width, fy / height])
        return int((self.lenses[:, 2:].log() - angle.log()).abs().sum(dim=-1).argmin())

    # Checkpoints.

    def get_extra_state(self) -> dict[str, Any]:
        return {"names": self.names, "parts": list(self.parts), "camera_of": self.camera_of}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        if (state["names"], tuple(state["parts"])) != (self.names, self.parts):
            raise ValueError("the checkpoint's photographs, or parts of them that were learnt, are others")

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "PhotographModel":
        """The model that a state_dict was taken from."""
        extra = state["_extra_state"]
        model = cls(extra["names"], extra["camera_of"], state["lenses"], extra["parts"])
        model.load_state_dict(state)
        return model

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # The patterns are the checkpoint's; one that knows of none held the means.
        if self.shots is not None and f"{prefix}shots" in state_dict:
            if f"{prefix}held" not in state_dict:
                self._hold([self._constant()] * self.shots.shape[1])
            for name in ("held", "kept"):
                own = getattr(self, name)
                setattr(self, name, torch.empty_like(state_dict.setdefault(prefix + name, own), device=own.device))
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
