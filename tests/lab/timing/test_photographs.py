# SPDX-License-Identifier: Apache-2.0
"""`nrfgs_lab.timing.photographs`: a made capture is read as a training reads it."""

import json

from nrfgs_lab.timing.photographs import Photographs, make


def test_a_capture_is_made_and_read(tmp_path):
    make(tmp_path / "small", 10, 60, 40)
    Photographs(tmp_path / "out.json", data=(tmp_path / "small",)).main()
    (record,) = json.loads((tmp_path / "out.json").read_text())["records"].values()
    assert record["size"] == [60, 40] and record["views"] == 9
    assert record["decoded_bytes"] == 10 * 60 * 40 * 3
    assert 0 < record["points"] <= record["splats"]
    assert {"all", "images"} <= record["seconds"].keys() and record["own_bytes"] > 0
