# SPDX-License-Identifier: Apache-2.0
"""What a scene costs in a file: the laboratory's command and table."""

import pytest

from nrfgs_lab.compact import Trade
from nrfgs_lab.pages.tables import compact_format
from nrfgs_ns.errors import InputError


def test_a_setting_that_is_none_is_refused_before_anything_is_trained(tmp_path):
    with pytest.raises(InputError, match="have no WORHT"):
        Trade(tmp_path, tmp_path / "out", work=tmp_path / "work", settings=("WORHT=1",)).main()


def test_between_two_files_the_trade_is_a_straight_line(monkeypatch):
    one = {"psnr_file": 30.0, "written": 5, "finetune": 2000}
    found = {
        "bonsai-model": {"train": {}},
        "bonsai-version-2": {**one, "bytes": 9_000_000, "loss_db": 0.0},
        "bonsai-rate-0.0001": {**one, "bytes": 5_000_000, "loss_db": 0.1},
        "bonsai-rate-0.001": {**one, "bytes": 2_000_000, "loss_db": 0.7},
    }
    monkeypatch.setattr(compact_format, "records", lambda study: found)
    assert compact_format.at("bonsai", "loss", "4") == "0.30" and compact_format.at("bonsai", "MB", "0.4") == "3.5"
