# SPDX-License-Identifier: Apache-2.0
"""Tables, figure and crops from records made by hand."""

import csv
import io
import json
import re

import numpy as np
import pytest
from PIL import Image

from nrfgs_ns.studies.bench_crops import crop_sheet, crop_side, largest_disagreement, numbered
from nrfgs_ns.studies.bench_report import draw_splats, report
from nrfgs_ns.studies.bench_spec import cells_of, identity, make_spec
from nrfgs_ns.studies.bench_table import COLUMNS, Row, as_csv, latex, markdown, ranks, with_averages

PSNR = next(column for column in COLUMNS if column.name == "PSNR")


def record(psnr, ssim=0.9, lpips=None, train=None, seconds=10.0, jobs=1, splats=1000, parts=1):
    test = {"psnr": psnr, "ssim": ssim, "ms_ssim": None, "l1": 0.01, "lpips": lpips}
    return {
        "machine": {"device": "a card", "torch": "2.11"},
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


def rows():
    """Two scenes, two runs; NRF's second seed on the second scene failed."""
    return [
        Row("s", "SH", "mcmc", {1: record(30.0, train=31.0), 2: record(31.0, train=33.0)}).fill(),
        Row("s", "NRF", "mcmc", {1: record(32.0, splats=500), 2: record(34.0, splats=700)}).fill(),
        Row("t_1", "SH", "mcmc", {1: record(20.0), 2: record(22.0)}).fill(),
        Row("t_1", "NRF", "mcmc", {1: record(21.0)}, {2: "FAILED"}).fill(),
    ]


def test_markdown():
    """By hand: means, sample deviations |a - b| / sqrt(2), best bold, second in italics, averages seed by seed."""
    lines = markdown(with_averages(rows())).splitlines()
    psnr = [column.name for column in COLUMNS].index("PSNR")
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert table[0][: 4 + 3] == ["scene", "run", "protocol", "seeds", "splats", "time s", "SSIM"]
    body = {(line[0], line[1]): line for line in table[2:]}
    assert body["s", "SH"][4 + psnr] == "_30.50 ± 0.71_"
    assert body["s", "NRF"][4 + psnr] == "**33.00 ± 1.41**"
    assert body["s", "NRF"][4] == "**600 ± 141**" and body["s", "SH"][4] == "_1,000 ± 0_"
    # Equal as written: no ranking.
    assert body["s", "SH"][6] == body["s", "NRF"][6] == "0.9000 ± 0.0000"
    assert (
        body["s", "SH"][-1] == "1.50 ± 0.71" and body["s", "SH"][-2] == "32.00 ± 1.41" and body["s", "NRF"][-1] == "-"
    )
    assert body["t_1", "NRF"][3] == "1 (1 FAILED)" and body["t_1", "NRF"][4 + psnr] == "21.00"
    assert body["average", "SH"][4 + psnr] == "_25.75 ± 1.06_"  # (30 + 20) / 2 and (31 + 22) / 2
    assert body["average", "NRF"][3] == "1 (1 FAILED)" and body["average", "NRF"][4 + psnr] == "**26.50**"
    assert any("Made on: a card, torch 2.11." in line for line in lines)
    assert body["s", "SH"][8] == "-", "LPIPS was not measured"


def test_latex():
    text = latex(rows())
    assert r"\textbf{33.00 $\pm$ 1.41}" in text and r"\underline{30.50 $\pm$ 0.71}" in text
    assert "t\\_1 & SH & mcmc & 2 & " in text
    width = text.splitlines()[2].count("&")
    assert all(line.count(" & ") == width for line in text.splitlines() if line.endswith(r"\\"))


def test_csv_has_plain_numbers():
    lines = list(csv.DictReader(io.StringIO(as_csv(rows()))))
    assert float(lines[1]["PSNR"]) == 33.0 and float(lines[1]["PSNR deviation"]) == pytest.approx(2**0.5)
    assert float(lines[0]["MB"]) == 2.0 and lines[0]["LPIPS"] == "" and lines[3]["PSNR deviation"] == ""


STRANGE = ["a|b", "50%", "_x_", "a & b", "f_1 {2} ~^", "$w^$", "a*b*", "<0.1>", "back\\slash", "two\nlines"]


def strange_rows():
    return [Row("s", name, "own", {1: record(30.0 + i)}).fill() for i, name in enumerate(STRANGE)]


def test_strange_names_break_no_table(tmp_path):
    """Each line has the table's columns, no letter of a name means anything, and the CSV gives the names back."""
    lines = [line for line in markdown(strange_rows()).splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(STRANGE)
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {4 + len(COLUMNS) + 1}
    names = [re.split(r"(?<!\\)\|", line)[2].strip() for line in lines[2:]]
    assert names == [
        *(r"a\|b", "50%", r"\_x\_", "a & b", "f_1 {2} ~^", "$w^$", r"a\*b\*", r"\<0.1>", r"back\\slash", "two lines")
    ]
    text = latex(strange_rows())
    for name in (
        *("a\\textbar{}b", "50\\%", "\\_x\\_", "a \\& b", "f\\_1 \\{2\\} \\textasciitilde{}\\textasciicircum{}"),
        *("\\$w\\textasciicircum{}\\$", "\\textless{}0.1\\textgreater{}", "back\\textbackslash{}slash", "two lines"),
    ):
        assert f"s & {name} & own & " in text
    assert [line["run"] for line in csv.DictReader(io.StringIO(as_csv(strange_rows())))] == STRANGE
    draw_splats([*strange_rows(), Row("$^$", "elsewhere", "own", {1: record(30.0)}).fill()], tmp_path)
    svg = (tmp_path / "splats.svg").read_text()
    assert "_x_</text>" in svg and ">$w^$</text>" in svg and ">$^$</text>" in svg
    assert ">elsewhere</text>" in svg, "a run that the first scene lacks is not in the legend"


def test_what_is_no_number_is_not_there():
    rows = [Row("s", "a", "own", {1: record(float("nan"))}).fill(), Row("s", "b", "own", {1: record(30.0)}).fill()]
    assert rows[0].text(PSNR) == "-" and ranks(rows, PSNR) == {}
    assert "nan" not in as_csv(rows)


def test_ranks_share_and_skip():
    group = [Row("s", str(i), "own", {1: record(psnr)}).fill() for i, psnr in enumerate([20.0, 21.004, 21.001, 19.0])]
    assert ranks(group, PSNR) == {0: 2, 1: 1, 2: 1}
    l1 = next(column for column in COLUMNS if column.name == "L1")
    assert ranks(group, l1) == {}
    gap = next(column for column in COLUMNS if column.name == "gap")
    assert gap.better == 0


def test_times_only_of_runs_that_were_alone():
    shared = Row("s", "SH", "own", {1: record(30.0, jobs=2)}).fill()
    alone = Row("s", "NRF", "own", {1: record(30.0, parts=2)}).fill()
    text = markdown([shared, alone])
    time, fps = (next(column for column in COLUMNS if column.name == name) for name in ("time s", "FPS"))
    assert shared.text(time) == shared.text(fps) == "-"
    assert (alone.text(time), alone.text(fps)) == ("10.0", "50.0")
    assert "shared their GPU" in text and "interrupted" in text


def test_one_scene_needs_no_average():
    assert len(with_averages(rows()[:2])) == 2


def test_figure_has_a_line_for_each_run(tmp_path):
    draw_splats(rows(), tmp_path)
    svg = (tmp_path / "splats.svg").read_text()
    assert "SH mcmc" in svg and "NRF mcmc" in svg and ">t_1<" in svg
    assert len(svg) < 100_000
    draw_splats(rows(), tmp_path)
    assert svg == (tmp_path / "splats.svg").read_text(), "the same numbers must give the same file"


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


def test_disagreement_is_found(pictures):
    """The window of 18 pixels must hold the whole patch of 10 where the errors differ, 50 / 255 against 0."""
    files = {label: numbered(folder) for label, folder in pictures.items()}
    pairs = [np.asarray(Image.open(found[2]), dtype=np.float32) / 255 for found in files.values()]
    truth, renders = pairs[0][:, :80], [pair[:, 80:] for pair in pairs]
    side = crop_side(60, 80)
    assert side == 18
    score, top, left = largest_disagreement(truth, renders, side)
    assert top <= 40 and top + side >= 50 and left <= 10 and left + side >= 20
    assert score == pytest.approx(0.5 * 50 / 255 * 100 / side**2, rel=1e-5)
    _, top, left = largest_disagreement(truth, renders[1:], side)  # of one run: where it is wrong
    assert top <= 40 and top + side >= 50


def test_sheet_shows_the_views_where_runs_differ(pictures, tmp_path):
    assert crop_sheet(pictures, tmp_path / "sheet.png")
    two = Image.open(tmp_path / "sheet.png")
    assert crop_sheet(pictures, tmp_path / "chosen.png", [2])
    one = Image.open(tmp_path / "chosen.png")
    assert two.height == 2 * one.height and two.width == one.width
    # The best view comes first: the upper half of the automatic sheet is the sheet of view 2.
    assert np.array_equal(np.asarray(two)[: one.height], np.asarray(one))
    below = np.asarray(one)[-200:-10, -200:-10]  # inside B's error map: 4 x 50 in the patch, else black
    assert set(np.unique(below)) == {0, 200}


def test_pictures_of_another_size_are_left_out(pictures, tmp_path):
    """A run on photographs scaled down, beside the others."""
    for file in numbered(pictures["A"]).values():
        with Image.open(file) as one:
            small = one.resize((80, 30))
        (tmp_path / "small").mkdir(exist_ok=True)
        small.save(tmp_path / "small" / file.name)
    assert crop_sheet(pictures, tmp_path / "sheet.png")
    assert crop_sheet({**pictures, "small": tmp_path / "small"}, tmp_path / "more.png")
    assert (tmp_path / "more.png").read_bytes() == (tmp_path / "sheet.png").read_bytes()


def test_no_pictures_no_sheet(tmp_path):
    assert not crop_sheet({"A": tmp_path / "none"}, tmp_path / "sheet.png")
    assert not (tmp_path / "sheet.png").exists()


def test_report_of_hand_made_records(tmp_path, pictures, capsys):
    spec = make_spec({"runs": {"A": "nrfgs", "B": "nrfgs-sh"}, "scenes": ["x/s"], "protocols": ["mcmc@9"]}, "test")
    for cell, psnr in zip(cells_of(spec), (30.0, 31.0), strict=True):
        content = {**record(psnr), "identity": identity(spec, cell, None)}
        (tmp_path / "out" / "runs").mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / "runs" / f"{cell.name}.json").write_text(json.dumps(content))
        (tmp_path / "work" / cell.name).mkdir(parents=True)
        pictures[cell.run.name].rename(tmp_path / "work" / cell.name / "pictures")
    report(spec, tmp_path / "out", tmp_path / "work", {})
    assert (tmp_path / "out" / "crops" / "x_s.png").exists()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [row["PSNR"] for row in summary] == [[30.0, None], [31.0, None]]
    assert "**31.00**" in capsys.readouterr().out
    # Pictures of records that are not to be used are not shown beside the others.
    (tmp_path / "out" / "crops" / "x_s.png").unlink()
    report(spec, tmp_path / "out", tmp_path / "work", {cell.name: "other options" for cell in cells_of(spec)})
    assert not (tmp_path / "out" / "crops" / "x_s.png").exists()
