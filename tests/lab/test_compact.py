# SPDX-License-Identifier: Apache-2.0
"""The command of the trade of bytes for dB."""

import pytest

from nrfgs_lab.compact import Trade
from nrfgs_ns.errors import InputError


def test_a_setting_that_is_none_is_refused_before_anything_is_trained(tmp_path):
    with pytest.raises(InputError, match="have no WORHT"):
        Trade(tmp_path, tmp_path / "out", work=tmp_path / "work", settings=("WORHT=1",)).main()
