# SPDX-License-Identifier: Apache-2.0
"""A study in one file is the study's folder, to seven digits."""

import json

from nrfgs_lab.results import pack, unpack


def test_a_folder_comes_back(tmp_path):
    folder = tmp_path / "out"
    (folder / "runs").mkdir(parents=True)
    image = [{"image": "a.png", "psnr": 30.123456789}]
    run = {"eval": {"psnr": 1 / 3, "per_image": image}, "measured": {"test": {"per_image": image}}, "splats": 123456789}
    run["train"] = {"splats": [[step, 10 * step] for step in range(0, 1101, 100)] + [[1149, 7]]}
    (folder / "runs" / "one.json").write_text(json.dumps(run))
    (folder / "table.md").write_text("| a |\n|---|\n")
    (folder / "splats.png").write_bytes(b"no text")
    pack(folder, tmp_path / "study.json")
    assert json.loads((tmp_path / "study.json").read_text())["study"] == "study"
    unpack(tmp_path / "study.json", tmp_path / "again")
    assert {path.name for path in (tmp_path / "again").rglob("*.*")} == {"one.json", "table.md"}
    assert (tmp_path / "again" / "table.md").read_text() == "| a |\n|---|\n"
    found = json.loads((tmp_path / "again" / "runs" / "one.json").read_text())
    assert found["train"]["splats"] == [[0, 0], [500, 5000], [1000, 10000], [1149, 7]]
    assert found["eval"] == {"psnr": 0.3333333} and found["splats"] == 123456789
    assert found["measured"]["test"]["per_image"] == [{"image": "a.png", "psnr": 30.12346}]
