# SPDX-License-Identifier: Apache-2.0
r"""What a table costs in a file, as a function that can be differentiated, and steps that are learnt with it.

A column of a table lies on a uniform grid, value = step * whole number. While it is trained, rounding is imitated by
noise that is uniform over a step (Balle et al., arXiv 1611.01704), or done, with the gradient of the identity. A number
x then costs

    -log2 P(x),    P(x) = sum_k w_k (F((x + step/2 - m - m_k) / b_k) - F((x - step/2 - m - m_k) / b_k)),

F the logistic function: a mixture of three, each column its own, about a mean m that is linear in the row's earlier
columns. Nothing of this is in a file: what a coder counts there is close to it.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

PARTS = 3
"""Logistics in a column's mixture."""
NARROWEST = 0.05
"""Of a logistic, in steps: narrower ones cost nothing less."""


class Coded(nn.Module):
    """A table whose values and steps are learnt for what they cost.

    Args:
        values: [N, C].
        steps: to begin with, > 0. [C]
    """

    def __init__(self, values: Tensor, steps: Tensor):
        super().__init__()
        columns = values.shape[1]
        self.values = nn.Parameter(values.clone())
        self.log_steps = nn.Parameter(steps.log())
        spread = values.std(dim=0, correction=0).clamp_min(steps) if len(values) else steps
        self.centers = nn.Parameter(
            values.mean(dim=0)[:, None].repeat(1, PARTS) if len(values) else spread[:, None] * 0
        )
        widths = spread.log()[:, None] + torch.tensor([-2.5, -1.0, 0.5], device=values.device)
        self.log_widths = nn.Parameter(widths)
        self.log_shares = nn.Parameter(torch.zeros(columns, PARTS, device=values.device))
        self.slopes = nn.Parameter(torch.zeros(columns, columns, device=values.device))

    @property
    def steps(self) -> Tensor:
        """[C]"""
        return self.log_steps.exp()

    @property
    def density(self) -> list[nn.Parameter]:
        """What only `bits` reads."""
        return [self.centers, self.log_widths, self.log_shares, self.slopes]

    def forward(self, rounded: bool) -> Tensor:
        """The table as a file would give it back: rounded, or with noise instead. [N, C]"""
        steps = self.steps
        if rounded:
            with torch.no_grad():
                places = self.values / steps
                off = places.round() - places
        else:
            off = torch.rand_like(self.values) - 0.5
        return self.values + steps * off

    def bits(self, values: Tensor) -> Tensor:
        """What values, as `forward` gives them, cost together: a scalar."""
        steps = self.steps[:, None]
        widths = self.log_widths.exp().clamp_min(NARROWEST * steps.detach())
        from_center = (values - values @ self.slopes.tril(-1).T)[..., None] - self.centers
        upper, lower = (from_center + 0.5 * steps) / widths, (from_center - 0.5 * steps) / widths
        # F(a) - F(b) = F(a) F(-b) (1 - exp(b - a)), which does not vanish in the tails.
        inside = logsigmoid(upper) + logsigmoid(-lower) + torch.log(-torch.expm1(-steps / widths))
        logs = torch.logsumexp(inside + self.log_shares.log_softmax(dim=-1), dim=-1)
        return -logs.sum() / math.log(2.0)


class CodedPlaces(Coded):
    """Means: a place costs what tells its cell from all others, whatever the density; halving a step costs a bit."""

    def bits(self, values: Tensor) -> Tensor:
        extent = (values.detach().amax(dim=0) - values.detach().amin(dim=0)).clamp_min(1e-30)
        cells = (extent.log() - self.log_steps).sum() / math.log(2.0)
        return len(values) * (cells - math.log2(max(len(values), 1)) + 1.0 / math.log(2.0))
