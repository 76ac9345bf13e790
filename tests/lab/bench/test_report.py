# SPDX-License-Identifier: Apache-2.0
"""Tables and crops from hand-made records."""

import json

import numpy as np
import pytest
from PIL import Image

from nrfgs_lab.bench.report import report
from nrfgs_lab.bench.spec import cells_of, identity, make_spec
from nrfgs_lab.bench.table import BY_NAME, Row, markdown, ranks, with_averages
from nrfgs_lab.results import pack, unpack

PSNR = BY_NAME["PSNR"]


def record(psnr, ssim=0.9, lpips=None, train=None, seconds=10.0, jobs=1, splats=1000, parts=1, device="a card"):
    test = {"psnr": psnr, "ssim": ssim, "ms_ssim": None, "l1": 0.01, "lpips": lpips}
    return {
        "machine": {"device": device, "torch": "2.11"},
        "jobs": jobs,
        "train": {"seconds": seconds, "parts": parts, "splats": [[0, 100], [100, splats]]},
        "measured": {
            "test": test,
            "train": None if train is None else {"psnr": train},
            "fps": 50.0,
            "splats": splats,
            "parameter_bytes": 2_000_000,
            "checkpoint_bytes": 6_000_000,
        },
    }


def test_what_is_no_number_is_not_there():
    rows = [Row("s", "a", "own", {1: record(float("nan"))}).fill(), Row("s", "b", "own", {1: record(30.0)}).fill()]
    assert rows[0].text(PSNR) == "-" and ranks(rows, PSNR) == {}
    assert "nan" not in markdown(rows)


def test_ranks_share_and_skip():
    group = [Row("s", str(i), "own", {1: record(psnr)}).fill() for i, psnr in enumerate([20.0, 21.004, 21.001, 19.0])]
    assert ranks(group, PSNR) == {0: 2, 1: 1, 2: 1}
    assert ranks(group, BY_NAME["L1"]) == {}


def test_times_are_of_runs_that_were_alone_and_ranked_on_one_machine():
    shared = Row("s", "SH", "own", {1: record(30.0, jobs=2)}).fill()
    alone = Row("s", "NRF", "own", {1: record(30.0, seconds=20.0, parts=2)}).fill()
    text = markdown([shared, alone])
    assert [shared.text(BY_NAME[name]) for name in ("time s", "FPS")] == ["-", "-"]
    assert [alone.text(BY_NAME[name]) for name in ("time s", "FPS")] == ["20.0", "50.0"]
    assert "shared their GPU" in text and "interrupted" in text
    one = Row("s", "SH", "own", {1: record(31.0, seconds=10.0)}).fill()
    other = Row("s", "SH", "own", {1: record(31.0, seconds=10.0, device="another")}).fill()
    assert ranks([one, alone], BY_NAME["time s"]) == {0: 1, 1: 2} and ranks([other, alone], BY_NAME["time s"]) == {}
    assert ranks([other, alone], PSNR) == {0: 1, 1: 2} and "different machines" in markdown([other, alone])


def test_an_average_is_of_rows_that_have_all_scenes():
    """NRF lacks seed 1 on one scene and failed it on the other; GS has no seed that both scenes have."""
    plan = {
        ("s", "SH"): ({1: record(30.0), 2: record(32.0)}, {}),
        ("t", "SH"): ({1: record(20.0), 2: record(22.0)}, {}),
        ("s", "NRF"): ({2: record(40.0)}, {1: "FAILED"}),
        ("t", "NRF"): ({2: record(40.0)}, {1: "missing"}),
        ("s", "GS"): ({1: record(50.0)}, {2: "missing"}),
        ("t", "GS"): ({2: record(50.0)}, {1: "missing"}),
    }
    rows = [Row(*place, "own", records, absent).fill() for place, (records, absent) in plan.items()]
    average = {row.run: row for row in with_averages(rows) if row.scene == "average"}
    assert average["SH"].text(PSNR) == "26.00 ± 1.41"  # of 25 and 27
    assert average["NRF"].absent == {1: "FAILED"} and average["NRF"].text(PSNR) == "40.00"
    assert average["GS"].mean(PSNR) is None and ranks(list(average.values()), PSNR) == {0: 2, 1: 1}


# Crops.


def picture(truth, render, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([truth, render], axis=1)).save(path)


@pytest.fixture
def pictures(tmp_path):
    """Three views, 60 x 80, of two runs. They differ in view 2 alone, at (40..50, 10..20); both are wrong in view 0."""
    rng = np.random.default_rng(0)
    for view in range(3):
        truth = rng.integers(0, 200, size=(60, 80, 3), dtype=np.uint8)
        for run in ("a", "b"):
            render = truth.copy()
            if view == 0:
                render += 30
            if view == 2 and run == "b":
                render[40:50, 10:20] += 50
            name = f"eval_img_{view:04d}" + ("_photo.png" if run == "a" else ".png")  # ours, and nerfstudio's
            picture(truth, render, tmp_path / run / name)
    return {"A": tmp_path / "a", "B": tmp_path / "b"}


def test_report_of_hand_made_records(tmp_path, pictures, capsys):
    spec = make_spec({"runs": {"A": "nrfgs", "B": "nrfgs-sh"}, "scenes": ["x/s"], "strategies": ["mcmc@9"]}, "test")
    for cell, psnr in zip(cells_of(spec), (30.0, 31.0), strict=True):
        content = {**record(psnr), "identity": identity(spec, cell, None)}
        (tmp_path / "out" / "runs").mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / "runs" / f"{cell.name}.json").write_text(json.dumps(content))
        (tmp_path / "work" / cell.name).mkdir(parents=True)
        pictures[cell.run.name].rename(tmp_path / "work" / cell.name / "pictures")
    report(spec, cells_of(spec), tmp_path / "out", tmp_path / "work", {})
    assert (tmp_path / "out" / "crops" / "x_s.png").exists()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [row["PSNR"] for row in summary] == [[30.0, None], [31.0, None]]
    assert "**31.00**" in capsys.readouterr().out
    # Pictures of records that are not to be used are not shown beside the others.
    (tmp_path / "out" / "crops" / "x_s.png").unlink()
    stale = {cell.name: "other options" for cell in cells_of(spec)}
    report(spec, cells_of(spec), tmp_path / "out", tmp_path / "work", stale)
    assert not (tmp_path / "out" / "crops" / "x_s.png").exists()


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
