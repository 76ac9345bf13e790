# SPDX-License-Identifier: Apache-2.0
"""Tables, crops, a front and prices from hand-made records; and noise is called noise."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t as student

from nrfgs_lab.bench.table import BY_NAME, Row, markdown, ranks, with_averages
from nrfgs_lab.bench.trade import changes, noise_bound, pareto_front, pooled_deviation
from nrfgs_lab.results import pack, unpack

PSNR = BY_NAME["PSNR"]


def record(psnr, ssim=0.9, lpips=None, train=None, seconds=10.0, jobs=1, splats=1000, parts=1, device="a card"):
    test = {"psnr": psnr, "ssim": ssim, "ms_ssim": None, "l1": 0.01, "lpips": lpips}
    measured = {"test": test, "train": None if train is None else {"psnr": train}, "fps": 50.0, "splats": splats}
    measured |= {"parameter_bytes": 2_000_000, "checkpoint_bytes": 6_000_000}
    trained = {"seconds": seconds, "parts": parts, "splats": [[0, 100], [100, splats]]}
    return {"machine": {"device": device, "torch": "2.11"}, "jobs": jobs, "train": trained, "measured": measured}


def test_ranks_share_and_skip_what_is_no_number():
    psnrs = [20.0, 21.004, 21.001, 19.0, float("nan")]
    group = [Row("s", str(i), "own", {1: record(psnr)}).fill() for i, psnr in enumerate(psnrs)]
    assert ranks(group, PSNR) == {0: 2, 1: 1, 2: 1}
    assert ranks(group, BY_NAME["L1"]) == {}
    assert group[-1].text(PSNR) == "-" and "nan" not in markdown(group)


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


def test_rows_beyond_their_budget_are_named():
    rows = [Row("s", name, f"mcmc@{most}", {1: record(30.0)}).fill() for name, most in (("A", 900), ("B", 1000))]
    assert "since they began with more: A." in markdown(rows)


def test_an_average_is_of_rows_that_have_all_scenes():
    """NRF lacks seed 1 on one scene and failed it on the other; GS has no seed that both have, SG one scene."""
    plan = {
        ("s", "SH"): ({1: record(30.0), 2: record(32.0)}, {}),
        ("t", "SH"): ({1: record(20.0), 2: record(22.0)}, {}),
        ("s", "NRF"): ({2: record(40.0)}, {1: "FAILED"}),
        ("t", "NRF"): ({2: record(40.0)}, {1: "missing"}),
        ("s", "GS"): ({1: record(50.0)}, {2: "missing"}),
        ("t", "GS"): ({2: record(50.0)}, {1: "missing"}),
        ("s", "SG"): ({1: record(60.0)}, {}),
    }
    rows = [Row(*place, "own", records, absent).fill() for place, (records, absent) in plan.items()]
    average = {row.run: row for row in with_averages(rows) if row.scene == "average"}
    assert average["SH"].text(PSNR) == "26.00 ± 1.41"  # of 25 and 27
    assert average["NRF"].absent == {1: "FAILED"} and average["NRF"].text(PSNR) == "40.00"
    assert "SG" not in average and average["GS"].mean(PSNR) is None
    assert ranks(list(average.values()), PSNR) == {0: 2, 1: 1}


def test_a_folder_comes_back(tmp_path):
    folder = tmp_path / "out"
    (folder / "runs").mkdir(parents=True)
    scores = {"psnr": 1 / 3, "per_image": [{"image": "a.png", "psnr": 30.123456789, "l1": 0.1}]}
    run = {"eval": scores, "measured": {"test": scores, "train": scores}, "splats": 123456789}
    run["train"] = {"splats": [[step, 10 * step] for step in range(0, 1101, 100)] + [[1149, 7]]}
    (folder / "runs" / "one.json").write_text(json.dumps(run))
    (folder / "table.md").write_text("| a |\n|---|\n")
    pack(folder, tmp_path / "study.json")
    unpack(tmp_path / "study.json", tmp_path / "again")
    assert (tmp_path / "again" / "table.md").read_text() == "| a |\n|---|\n"
    found = json.loads((tmp_path / "again" / "runs" / "one.json").read_text())
    assert found["train"]["splats"] == [[0, 0], [500, 5000], [1000, 10000], [1149, 7]]
    assert found["eval"] == found["measured"]["train"] == {"psnr": 0.3333333} and found["splats"] == 123456789
    assert found["measured"]["test"]["per_image"] == [{"image": "a.png", "psnr": 30.12346}]


# The trade: a front and prices.
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12))
def test_front_is_what_nothing_beats(points):
    """Against the definition, on a grid so coarse that ties are common."""

    def beats(a, b):
        return a[0] <= b[0] and a[1] >= b[1] and a != b

    expected = {i for i, point in enumerate(points) if not any(beats(other, point) for other in points)}
    front = pareto_front(points)
    assert set(front) == expected and len(front) == len(expected)
    assert [points[i][0] for i in front] == sorted(points[i][0] for i in front)


def test_pooled_deviation_by_hand():
    # Variances 2 (1 degree of freedom) and 1 (2): s^2 = (2 + 2) / 3. A sample of one adds nothing.
    deviation, freedom = pooled_deviation([[1.0, 3.0], [4.0, 5.0, 6.0], [9.0]])
    assert freedom == 3 and deviation == pytest.approx(math.sqrt(4 / 3))
    bound = noise_bound(deviation, freedom, 2, 3)
    assert bound == pytest.approx(student.ppf(0.975, 3) * math.sqrt(4 / 3) * math.sqrt(1 / 2 + 1 / 3))
    assert pooled_deviation([[1.0], [2.0]]) == (None, 0) and noise_bound(None, 0, 1, 1) == math.inf


def row(name, *records):
    return Row("s", name, "own", dict(enumerate(records))).fill()


def test_differences_inside_the_noise_are_marked():
    """One deviation for all: pairs 0.2 apart have s = 0.1414, 3 degrees of freedom; t(3) s = 3.182 * 0.1414 = 0.450."""
    psnrs = {"default": (30.0, 30.2), "near": (30.4, 30.6), "far": (30.5, 30.7)}
    rows = [row(name, *map(record, pair)) for name, pair in psnrs.items()]
    result = changes(rows, rows[0], PSNR, ratio=False)
    assert result["near"].value == pytest.approx(0.4) and result["near"].is_noise
    assert result["far"].value == pytest.approx(0.5) and not result["far"].is_noise
    assert result["far"].noise == pytest.approx(0.4501, abs=1e-4)
    # One seed each: the spread is unknown.
    single = [row("default", record(30.0)), row("far", record(40.0))]
    assert changes(single, single[0], PSNR, ratio=False)["far"].is_noise


def test_costs_are_ratios_of_geometric_means():
    seconds = {"default": (10.0, 40.0), "half": (5.0, 20.0)}
    rows = [row(name, *(record(30.0, seconds=one) for one in pair)) for name, pair in seconds.items()]
    rows += [row("shared", record(30.0, jobs=2), record(30.0, jobs=2))]
    result = changes(rows, rows[0], BY_NAME["time s"], ratio=True)
    assert result["half"].value == pytest.approx(0.5)
    # The same spread, a factor of 4, in both: s = ln 4 / sqrt 2, 2 degrees of freedom, bound t(2) s = 4.303 * 0.980.
    assert result["half"].noise == pytest.approx(math.exp(4.3027 * math.log(4) / math.sqrt(2)), rel=1e-4)
    assert result["half"].is_noise and "shared" not in result  # its time was not measured alone
    rows = [row("default", record(30.0)), row("empty", record(5.0, splats=0))]
    assert set(changes(rows, rows[0], BY_NAME["splats"], ratio=True)) == {"default"}
