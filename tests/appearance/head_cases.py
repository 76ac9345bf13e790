# SPDX-License-Identifier: Apache-2.0
"""Splats and weights for the tests of appearance heads, none of them at a start where a term would be zero."""

import torch
from torch.testing import assert_close

from nrfgs_ns.appearance.head import AppearanceHead, AppearanceHeadConfig, Field


def awake(config: AppearanceHeadConfig, dtype: torch.dtype = torch.float64) -> AppearanceHead:
    """A head fully switched on, with shared weights large enough to be felt."""
    torch.manual_seed(1)
    head = config.setup().to(dtype)
    for weights in head.parameters():
        weights.data += 0.3 * torch.randn_like(weights)
    return head


def scene(head: AppearanceHead, count: int = 11, dtype: torch.dtype = torch.float64, seed: int = 0):
    """A table of random splats within [-2, 2]^3, two thirds of which are visible, out of order, from a camera each."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=dtype)

    torch.manual_seed(seed)
    stored = {name: value.to(dtype) for name, value in head.splat_params(rand(count, 3)).items()}
    splats = {"means": 4 * rand(count, 3) - 2, "opacities": 2 * rand(count, 1) - 1}
    splats |= {name: value + 0.5 * rand(*value.shape) - 0.25 for name, value in stored.items()}
    visible = torch.randperm(count, generator=generator)[: 2 * count // 3]
    return splats, visible, 6 * rand(len(visible), 3) - 3


def random_field(config: AppearanceHeadConfig) -> tuple[Field, torch.Tensor, torch.Tensor]:
    """A field of 40 splats in float32, the visible ones, and a camera centre for each."""
    head = awake(config, torch.float32).requires_grad_(False)
    splats, visible, centers = scene(head, count=40, dtype=torch.float32)
    return Field(head, splats), visible, centers


def assert_same(field: Field, other: Field, visible: torch.Tensor, centers: torch.Tensor, atol: float = 2e-5) -> None:
    """Two fields look the same. By default up to float32's rounding: sums of up to 60 products of numbers of order 1 to
    10, rounded at 2^-24 each, behind slopes of at most 0.2."""
    pair = (each.head(each.splats, visible, centers) for each in (field, other))
    for a, b in zip(*pair, strict=True):
        assert_close(a, b, rtol=0, atol=atol)
