# SPDX-License-Identifier: Apache-2.0
"""Some views of many."""

import pytest

from nrfgs_ns.data.views import evenly_spaced


@pytest.mark.parametrize(
    "total, wanted, expected", [(10, 4, [0, 2, 5, 7]), (3, 5, [0, 1, 2]), (5, 5, [0, 1, 2, 3, 4]), (5, 0, [])]
)
def test_evenly_spaced(total, wanted, expected):
    assert evenly_spaced(total, wanted) == expected
