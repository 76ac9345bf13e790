# SPDX-License-Identifier: Apache-2.0
"""The kernels of a photograph's exposure in Triton's interpreter. Run by kernels/test_interpreted.py."""

import pytest
import quick_interpreter  # noqa: F401
from photograph_cases import assert_near, case

from nrfgs_ns.image import photograph_triton


@pytest.mark.parametrize("parts", [("exposure",), ("white-balance",), ("exposure", "white-balance")])
@pytest.mark.parametrize(("size", "spread"), [((9, 17), 0.4), ((1, 1), 0.0), ((16, 30), 2.0)])
def test_values_and_gradients(parts, size, spread, monkeypatch):
    monkeypatch.setattr(photograph_triton, "BLOCK", 256)
    model, image, d_taken = case(*size, parts, spread)
    taken = photograph_triton.Exposed.apply(image, model.shots, 3, model.exponents)
    assert_near(taken, model, image, d_taken, 3)


def test_more_partial_sums_than_a_block(monkeypatch):
    monkeypatch.setattr(photograph_triton, "BLOCK", 2)
    monkeypatch.setattr(photograph_triton, "SUMS", 64)
    model, image, d_taken = case(7, 13, ("exposure", "white-balance"), 0.5)
    assert_near(photograph_triton.Exposed.apply(image, model.shots, 0, model.exponents), model, image, d_taken, 0)
