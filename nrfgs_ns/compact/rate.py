# SPDX-License-Identifier: Apache-2.0
r"""The size of a table in a file as a differentiable function, and learnable steps.

A column of a table lies on a uniform grid, value = step * integer. In training, rounding is imitated by noise that is
uniform over a step (Balle et al., arXiv 1611.01704), or done, with the gradient of the identity. A number x then costs

    -log2 P(x),    P(x) = sum_k w_k (F((x + step/2 - m - m_k) / b_k) - F((x - step/2 - m - m_k) / b_k)),

F the logistic function: a mixture of two for each column, about a mean m that is linear in the two rows before and in
the row's earlier columns; its widths b_k grow with the neighbours' distances from their means. A file's coder
(`entropy.py`) predicts from the same neighbours, but nothing of this is in a file.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

WIDTHS = (-2.0, -0.3)
"""Logarithms of the logistics' initial widths, in standard deviations of the column."""
SEEN = 0.3
"""Added to the neighbours' errors, in usual widths."""
NARROWEST = 0.05
"""Width of the narrowest logistic, in steps: narrower ones cost no less."""


class Rounded(nn.Module):
    """A table with learnable values [N, C] and steps [C] > 0."""

    def __init__(self, values: Tensor, steps: Tensor):
        super().__init__()
        self.values = nn.Parameter(values.clone())
        self.log_steps = nn.Parameter(steps.log())

    @property
    def steps(self) -> Tensor:
        return self.log_steps.exp()

    def forward(self, rounded: bool) -> Tensor:
        """The table as a file would give it back: rounded, or with noise instead. [N, C]"""
        steps = self.steps
        places = (self.values / steps).detach()
        off = places.round() - places if rounded else torch.rand_like(places) - 0.5
        return self.values + steps * off


class Density(nn.Module):
    """The distribution of a table's columns given their neighbours; `values` [N, C] start it."""

    def __init__(self, values: Tensor):
        super().__init__()
        columns = values.shape[1]
        values = values if len(values) else values.new_zeros(1, columns)
        spread, mean = values.std(dim=0, correction=0), values.mean(dim=0)
        widths = spread.clamp_min(1e-6).log()[:, None] + values.new_tensor(WIDTHS)
        self.centers = nn.Parameter(mean[:, None].repeat(1, len(WIDTHS)))
        self.log_widths = nn.Parameter(widths)
        self.log_shares = nn.Parameter(torch.zeros_like(widths))
        self.of_left = nn.Parameter(values.new_zeros(columns, columns))
        self.of_left_before = nn.Parameter(values.new_zeros(columns, columns))
        self.of_before = nn.Parameter(values.new_zeros(2, columns))
        self.activity = nn.Parameter(values.new_zeros(4, columns))
        self.growth = nn.Parameter(values.new_zeros(columns))

    def bits(self, values: Tensor, steps: Tensor) -> Tensor:
        """Bits of each row of values [N, C] rounded to steps [C], [N]."""
        before, before_2 = _earlier(values, 1), _earlier(values, 2)
        mean = values @ self.of_left.tril(-1).T + before @ self.of_left_before.tril(-1).T
        residuals = values - (mean + self.of_before[0] * before + self.of_before[1] * before_2)

        # The neighbours' errors in usual widths, as constants.
        usual = self.log_widths.detach().mean(dim=-1).exp().maximum(steps.detach())
        off = residuals.detach().abs() / usual
        left, left_2 = (nn.functional.pad(off, (k, 0))[:, : off.shape[1]] for k in (1, 2))
        shares = self.activity.softmax(dim=0)
        seen = shares[0] * _earlier(off, 1) + shares[1] * _earlier(off, 2) + shares[2] * left + shares[3] * left_2
        grown = (self.growth * torch.log(seen + SEEN))[..., None]

        steps = steps[:, None]
        widths = (self.log_widths + grown).exp().maximum(NARROWEST * steps.detach())
        from_center = residuals[..., None] - self.centers
        upper, lower = (from_center + 0.5 * steps) / widths, (from_center - 0.5 * steps) / widths
        # F(a) - F(b) = F(a) F(-b) (1 - exp(b - a)), which does not vanish in the tails.
        inside = logsigmoid(upper) + logsigmoid(-lower) + torch.log(-torch.expm1(-steps / widths))
        return -torch.logsumexp(inside + self.log_shares.log_softmax(dim=-1), dim=-1).sum(dim=-1) / math.log(2.0)


def _earlier(values: Tensor, count: int) -> Tensor:
    """Rows [N, C] `count` rows later; the first ones are 0."""
    return nn.functional.pad(values, (0, 0, count, 0))[: len(values)]


def bits_of_places(means: Tensor, steps: Tensor) -> Tensor:
    """Bits of one of N means [N, 3]: the choice of a cell of size `steps` [3] in their box, in any order."""
    extent = (means.detach().amax(dim=0) - means.detach().amin(dim=0)).clamp_min(1e-30)
    cells = (extent.log() - steps.log()).clamp_min(0.0).sum() / math.log(2.0)
    return (cells - math.log2(max(len(means), 1)) + 1.0 / math.log(2.0)).clamp_min(0.0)
