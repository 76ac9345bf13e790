# SPDX-License-Identifier: Apache-2.0
"""FLIP, where the package that computes it is there."""

import sys

import numpy as np
import pytest

from nrfgs_lab.flip import flip
from nrfgs_ns.errors import InputError


def test_without_the_package_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(InputError, match="pip install flip-evaluator"):
        flip(np.zeros((8, 8, 3)), np.zeros((8, 8, 3)))


def test_equal_is_zero_different_is_more_and_outside_a_mask_nothing_counts():
    pytest.importorskip("flip_evaluator")
    truth = np.random.default_rng(0).random((40, 50, 3))
    worse = np.clip(truth + 0.2, 0, 1)
    assert flip(truth, truth) == 0.0
    assert 0 < flip(np.clip(truth + 0.05, 0, 1), truth) < flip(worse, truth) <= 1
    left = np.zeros((40, 50), dtype=bool)
    left[:, :25] = True
    half = np.where(left[..., None], truth, worse)
    assert flip(half, truth, left) == 0.0 < flip(half, truth, ~left)
    assert flip(half, truth, np.zeros_like(left)) is None
