# SPDX-License-Identifier: Apache-2.0
"""Whole numbers for tables: each error within the bound that its function states."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nrfgs_ns.compact.quantise import NEAR, OCTAHEDRAL, Grid, from_morton, morton, nearest_turn


@given(seed=st.integers(0, 99), count=st.integers(0, 40))
def test_morton_interleaves_and_back(seed, count):
    codes = np.random.default_rng(seed).integers(0, 2**21, (count, 3))
    codes[:1] = 2**21 - 1
    interleaved = morton(codes)
    assert (from_morton(interleaved) == codes).all()
    for row, number in zip(codes[:3], interleaved, strict=False):  # by hand, bit for bit
        by_hand = sum(((int(row[axis]) >> k) & 1) << (3 * k + axis) for k in range(21) for axis in range(3))
        assert by_hand == int(number)


@given(seed=st.integers(0, 99))
def test_grids_are_half_a_step_off_at_most(seed):
    random = np.random.default_rng(seed)
    values = random.normal(size=(30, 3)) * 10.0 ** random.uniform(-4, 4, 3)
    grid = Grid(values.min(axis=0), np.full(3, 0.3))
    rounding = 4 * np.finfo(float).eps * np.abs(values).max(axis=0)
    assert (np.abs(grid.values(grid.codes(values)) - values) <= grid.step / 2 + rounding).all()


def ellipsoids(quats, scales):
    """R S R^T, [N, 3, 3]."""
    turns = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
    return turns * scales[:, None, :] @ turns.transpose(0, 2, 1)


@given(seed=st.integers(0, 99))
def test_the_nearest_turn_draws_the_same_ellipsoid(seed):
    random = np.random.default_rng(seed)
    quats = random.normal(size=(200, 4)) * 10.0 ** random.uniform(-3, 3, (200, 1))
    quats[:24] = OCTAHEDRAL
    scales = random.normal(size=(200, 3))
    turned, permuted = nearest_turn(quats, scales)
    assert np.allclose(np.linalg.norm(turned, axis=1), 1.0) and (turned[:, 0] > NEAR).all()
    assert np.allclose(ellipsoids(turned, permuted), ellipsoids(quats, scales), atol=1e-9)
    again, same = nearest_turn(turned, permuted)
    assert np.allclose(again, turned) and (same == permuted).all()
