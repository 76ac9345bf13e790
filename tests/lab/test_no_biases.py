# SPDX-License-Identifier: Apache-2.0
"""The heads without biases are the others but for these."""

import pytest
import torch

from nrfgs_lab.no_biases import nrf, vdgs
from nrfgs_ns.method_config import nrfgs, nrfgs_vdgs


@pytest.mark.parametrize(("without", "plain", "biases"), [(nrf, nrfgs, 2 * (64 + 4)), (vdgs, nrfgs_vdgs, 32 + 32 + 1)])
def test_only_biases_are_missing(without, plain, biases):
    head, other = (one.config.pipeline.model.appearance.setup() for one in (without, plain))
    there = {name: tuple(value.shape) for name, value in other.named_parameters() if not name.endswith("bias")}
    assert {name: tuple(value.shape) for name, value in head.named_parameters()} == there
    assert (
        sum(value.numel() for value in other.parameters()) - sum(value.numel() for value in head.parameters()) == biases
    )
    splats = {"means": torch.randn(5, 3), "opacities": torch.zeros(5, 1), **head.splat_params(torch.rand(5, 3))}
    seen = head(splats, torch.arange(5), torch.tensor([[0.0, 0.0, 4.0]]).expand(5, 3))
    assert seen.colors.shape == (5, 3) and torch.isfinite(seen.colors).all()
    assert without.config.optimizers.keys() == plain.config.optimizers.keys()
