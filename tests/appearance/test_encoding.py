# SPDX-License-Identifier: Apache-2.0
import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from nrfgs_ns.appearance.encoding import view_geometry

coordinate = st.floats(-1e6, 1e6, allow_nan=False, width=32)
point = st.tuples(coordinate, coordinate, coordinate)


@given(point, point, st.sampled_from([1e-3, 0.01, 1.0]))
def test_direction_and_distance(mean, center, eps):
    mean, center = torch.tensor([mean]).double(), torch.tensor(center).double()
    directions, log_distance = view_geometry(mean, center, eps)
    true = (center - mean).norm()
    assert_close(log_distance.exp().squeeze(), true.clamp_min(eps))
    assert_close(directions.norm(), (true / true.clamp_min(eps)))
    assert_close(directions * true.clamp_min(eps), center - mean)


def test_camera_on_the_splat_has_finite_values_and_gradients():
    mean = torch.zeros(1, 3, requires_grad=True)
    directions, log_distance = view_geometry(mean, torch.zeros(3), eps=0.01)
    assert directions.tolist() == [[0.0, 0.0, 0.0]]
    assert_close(log_distance, torch.tensor([[math.log(0.01)]]))
    (directions.sum() + log_distance.sum()).backward()
    # d = v / eps there, so its slope is -1 / eps; the floored distance does not move.
    assert_close(mean.grad, torch.full((1, 3), -100.0))
