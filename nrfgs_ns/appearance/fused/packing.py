# SPDX-License-Identifier: Apache-2.0
"""Where the field's weights and features lie in the fused kernels: two index maps, built once.

D numbers in a latent; R tiles of four features, P = 4 R columns of features and of latents, the same power of two for
both; H hidden units of both branches side by side, rounded up to a power of two.

- Features, four lanes in a tile: tile 0 is the direction and the constant 1, whose row of W1 is the first layer's bias;
  tiles 1 + 2k and 2 + 2k are the sines and cosines of band k; tile R - 1 is (c, alpha). Lane 3 of tile 1 is log r. What
  is left over has no weights. Lane l of tile i is feature 4 i + l.
- Latents, four tiles for every sixteen: latent 16 h + 4 l + t is in lane l of tile 4 h + t, so that four neighbours of
  the table, which are read at once, are in one lane.
- Inputs X [., 2P]: lane l of tile i of the latents in column 2 (4 i + l), of the features in the next one. Of every
  eight columns tensor cores keep two neighbours in a thread: a latent and a feature, of one lane and all tiles.
- W1 [2P, H]: zero where a branch does not see an input.
- W2 [H, 8] and b2 [8]: output j of the low branch in column 2j, of the high branch in column 2j + 1. So column 6 is
  d_alpha and column 7 the gate's logit w.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

OUTPUT_COLUMNS = 8
CENTER_SLOTS = 4
"""Numbers kept behind the weights' partial gradients for the camera centre's, 3 and a filler."""


@dataclass(frozen=True)
class Packing:
    """Index maps and sizes; on the CPU until `to`."""

    latent_dim: int
    width: int  # P
    hidden: int  # H, a power of two >= 16
    num_bands: int  # K >= 1
    gather: Tensor
    """[2 P H + 8 H + 8], int64: packed weights = flat[gather], flat being all parameters in a row and then one 0."""
    scatter: Tensor
    """[number of weights], int64: gradient of the flat parameters = gradient of the packed ones [scatter]."""
    shapes: tuple[torch.Size, ...]
    """Shapes of the parameters, in the order of `flat`."""

    def to(self, device: torch.device) -> "Packing":
        """The same with its tensors on `device`."""
        return replace(self, gather=self.gather.to(device), scatter=self.scatter.to(device))


def pack(latent_dim: int, num_bands: int, use_distance: bool, branches: Sequence[nn.Sequential]) -> Packing:
    """Lay out a field.

    Args:
        use_distance: whether the log distance is among the inputs.
        branches: low and high, or the only one; each is Linear - ReLU - Linear.
    """
    width = max(16, _power_of_two(latent_dim), 4 * _power_of_two(2 * num_bands + 2))
    hidden = max(16, _power_of_two(sum(branch[0].out_features for branch in branches)))

    def lanes(tile: int) -> list[int]:
        return [2 * (4 * tile + lane) + 1 for lane in range(4)]

    *direction, one = lanes(0)
    *color, alpha = lanes(width // 4 - 1)
    latents = [2 * (4 * (i // 16 * 4 + i % 4) + i // 4 % 4) for i in range(latent_dim)]
    shared = latents + color + ([lanes(1)[3]] if use_distance else [])
    low_bands, *high_bands = (lanes(1 + 2 * k)[:3] + lanes(2 + 2 * k)[:3] for k in range(num_bands))
    high_bands = sum(high_bands, [])
    inputs = [[*shared, alpha, *direction, *low_bands], [*shared, *high_bands]]
    if len(branches) == 1 and branches[0][0].in_features > len(inputs[0]):
        inputs[0] += high_bands  # the single branch sees everything

    shapes = tuple(parameter.shape for branch in branches for parameter in branch.parameters())
    zero = sum(shape.numel() for shape in shapes)
    first = torch.full((2 * width, hidden), zero)
    second = torch.full((hidden, OUTPUT_COLUMNS), zero)
    bias = torch.full((OUTPUT_COLUMNS,), zero)
    ranges = torch.arange(zero).split([shape.numel() for shape in shapes])
    positions = [numbers.view(shape) for numbers, shape in zip(ranges, shapes, strict=True)]
    unit = 0
    for branch in range(len(branches)):
        w1, b1, w2, b2 = positions[4 * branch : 4 * branch + 4]
        units = torch.arange(unit, unit + len(b1))
        unit += len(b1)
        outputs = 2 * torch.arange(len(b2)) + branch
        first[torch.tensor(inputs[branch])[:, None], units] = w1.T
        first[one, units] = b1
        second[units[:, None], outputs] = w2.T
        bias[outputs] = b2
    gather = torch.cat([first.flatten(), second.flatten(), bias])
    scatter = torch.empty(zero + 1, dtype=torch.int64)
    scatter[gather] = torch.arange(len(gather))
    return Packing(latent_dim, width, hidden, num_bands, gather, scatter[:zero].clone(), shapes)


def _power_of_two(n: int) -> int:
    """The smallest power of two >= n, n >= 1."""
    return 1 << (n - 1).bit_length()
