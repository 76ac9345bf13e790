# SPDX-License-Identifier: Apache-2.0
"""`nrfgs_lab.timing.photographs`: a made capture is read as a training reads it."""

import json

from nrfgs_lab.timing import photographs
from nrfgs_lab.timing.photographs import Photographs


def test_a_capture_is_made_and_read(tmp_path, monkeypatch):
    options = "--pipeline.datamanager.image-memory 0 --pipeline.model.dense-start off"
    monkeypatch.setitem(photographs.CAPTURES, "small", (10, 60, 40, options))
    Photographs(tmp_path / "out.json", ("small",)).main()
    (record,) = json.loads((tmp_path / "out.json").read_text())["records"].values()
    assert record["size"] == [60, 40] and record["kept_in"] == "files"
    assert record["decoded_bytes"] == 10 * 60 * 40 * 3
    assert {"all", "images"} <= record["seconds"].keys() and record["own_bytes"] > 0
