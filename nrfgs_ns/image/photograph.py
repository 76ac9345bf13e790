# SPDX-License-Identifier: Apache-2.0
"""Exposure and white balance of each photograph, learnt with the scene.

The scene's colours x are those of the photographs' mean look. A photograph multiplies the light of each channel by 2^s,
s in stops. Under sRGB's curve above its linear toe a pixel becomes

    y = k (x + a) - a,    k = 2^(s / GAMMA),    a = TOE,

which is y = x where s = 0. A photograph has three numbers: exposure, the same in all channels, and white balance,
log2(R/G) and log2(B/G), with mean zero over the channels. Their means over the photographs belong to the scene and stay
zero (`center_`); other patterns that more likely belong to it, such as brightness that changes slowly with the position
(`overlap.estimate`), keep their initial values.

This is the exposure and color part of PPISP (Deutsch et al., arXiv 2601.18336), on pixels instead of linear light.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import Parameter

GAMMA = 2.4
"""sRGB's exponent."""
TOE = 0.055
"""sRGB's offset."""
BASIS = ((1.0, 1.0, 1.0), (2 / 3, -1 / 3, -1 / 3), (-1 / 3, -1 / 3, 2 / 3))
"""Stops of red, green and blue for one stop of each number of a photograph: exposure, log2(R/G), log2(B/G)."""


class PhotographModel(nn.Module):
    """Exposures and white balances of P photographs.

    Args:
        names: of the photographs. [P]
        start: initial numbers, of any mean; None: 0. [P, 3]
        held: for each number, orthonormal patterns over the photographs that keep their initial values, the constant
            among them; None: the constants alone. [P, K] each
    """

    def __init__(self, names: Sequence[str], start: Tensor | None = None, held: Sequence[Tensor] | None = None):
        super().__init__()
        self.names = list(names)
        self.register_buffer("exponents", (torch.tensor(BASIS).T / GAMMA).contiguous(), persistent=False)
        start = torch.zeros(len(names), 3) if start is None else start.float()
        self.shots = Parameter(start - start.mean(dim=0))
        """exposure, log2(R/G) and log2(B/G) of each photograph, in stops. [P, 3]"""
        if held is None:
            held = [torch.full((len(names), 1), len(names) ** -0.5)] * 3
        patterns = torch.block_diag(*(of_number.T for of_number in held))
        self.register_buffer("held", patterns.view(-1, 3, len(names)).transpose(1, 2).flatten(1))
        self.register_buffer("kept", self.held @ self.shots.detach().flatten())

    def forward(self, image: Tensor, index: int) -> Tensor:
        """The image [H, W, 3], in the mean look and not clamped, as the photograph exposed it; in [0, 1]."""
        # No matrix product: a recorded step would hold cuBLAS's memory by its address, which PyTorch may give back.
        gain = (self.exponents * self.shots[index]).sum(dim=-1).exp2()
        return torch.addcmul(gain * TOE - TOE, image, gain).clamp(0.0, 1.0)

    @torch.no_grad()
    def center_(self) -> None:
        """Reset the held patterns to their initial values; called after each step."""
        flat = self.shots.view(-1)
        flat.addmv_(self.held.T, torch.addmv(self.kept, self.held, flat, alpha=-1.0))

    def get_extra_state(self) -> dict[str, Any]:
        return {"names": self.names}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.names = state["names"]

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "PhotographModel":
        """The model that a state_dict was taken from."""
        model = cls(state["_extra_state"]["names"])
        model.load_state_dict(state)
        return model

    def _load_from_state_dict(self, state_dict, prefix, *args):
        for name in ("held", "kept"):  # the checkpoint's patterns, whatever their number
            if (patterns := state_dict.get(prefix + name)) is not None:
                setattr(self, name, torch.empty_like(patterns, device=self.shots.device))
        super()._load_from_state_dict(state_dict, prefix, *args)
