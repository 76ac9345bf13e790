# SPDX-License-Identifier: Apache-2.0
"""The kernel of the growth's statistics in Triton's interpreter against its twin."""

import pytest
import quick_interpreter  # noqa: F401
import torch
from torch.testing import assert_close

from nrfgs_ns.densification.statistics import add_in_torch, raise_in_torch
from nrfgs_ns.densification.statistics_triton import add, raise_maxima


@pytest.mark.parametrize("names", [("grad2d", "count"), ("grad2d", "count", "radii")])
@pytest.mark.parametrize("visible", [0, 1, 300])
def test_the_kernel_adds_what_its_twin_adds(names, visible):
    torch.manual_seed(0)
    rows = torch.randperm(400)[:visible].sort().values
    gradients, radii = torch.randn(visible, 2), torch.randint(0, 5, (visible,), dtype=torch.int32)
    mine = {name: torch.rand(400) for name in names}
    theirs = {name: value.clone() for name, value in mine.items()}
    add(mine["grad2d"], mine["count"], mine.get("radii"), rows, gradients, radii, (400.0, 300.0), 1 / 800.0)
    add_in_torch(theirs, rows, gradients, radii, (400.0, 300.0), 800.0)
    for name in names:
        assert_close(mine[name], theirs[name], rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("grows", [True, False])
@pytest.mark.parametrize("peak", [True, False])
@pytest.mark.parametrize("visible", [0, 1, 300])
def test_the_kernel_raises_what_its_twin_raises(grows, peak, visible):
    torch.manual_seed(0)
    rows, radii = torch.randperm(400)[:visible], torch.randint(0, 5, (visible,), dtype=torch.int32)
    gradients, change = torch.randn(visible, 2) if grows else None, torch.rand(visible) - 0.5 if peak else None
    mine = [torch.rand(400) / 50, torch.rand(400) * 300 if grows else None, torch.rand(400) - 1.0 if peak else None]
    theirs = [None if value is None else value.clone() for value in mine]
    raise_maxima(*mine, rows, radii, gradients, change, 1 / 400.0, (400.0, 300.0))
    raise_in_torch(*theirs, rows, radii, gradients, change, 400.0, (400.0, 300.0))
    for value, twin in zip(mine, theirs, strict=True):
        if twin is not None:
            assert_close(value, twin, rtol=1e-6, atol=0.0)
