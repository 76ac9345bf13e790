# SPDX-License-Identifier: Apache-2.0
"""Knobs become a benchmark, its records become a front and prices, and noise is called noise."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t as student

from nrfgs_lab.bench.spec import make_spec
from nrfgs_lab.bench.table import BY_NAME, Row
from nrfgs_lab.bench.trade import (
    PSNR,
    Change,
    changes,
    noise_bound,
    pareto_front,
    pooled_deviation,
    price,
)
from nrfgs_ns.errors import InputError

D = "--pipeline.model.appearance.latent-dim"
KNOBS = {
    "default": {"method": "nrfgs", "options": "--a 1"},
    "scenes": ["s"],
    "seeds": [1, 2],
    "steps": 100,
    "knobs": {
        "D": {"option": D, "values": [4, 8]},
        "steps": {"steps": [50]},
        "budget": {"strategies": ["mcmc@200"]},
        "head": {"settings": {"SH": {"method": "nrfgs-sh", "options": "--b 2"}, "one": {"options": "--c 3"}}},
    },
}


@pytest.mark.parametrize(
    "change, words",
    [
        ({"knobs": []}, "knobs must map"),
        ({"knobs": {"steps": {"steps": 5}}}, "needs option and a list of values, or a list of steps"),
        ({"knobs": {"head": {"settings": {"x": {"option": "--a"}}}}}, "head x: unknown key"),
        ({"knobs": {"head": {"settings": {"x": 5}}}}, "head x must be a method, or"),
        ({"knobs": {"a": {"settings": {"b c": {}}}, "a b": {"settings": {"c": {}}}}}, "there twice"),
        ({"default": {"options": "--a"}}, "default names no method"),
        ({"runs": {"x": "nrfgs"}}, "Leave runs out"),
        ({"strategies": ["splatfacto", "original"]}, "strategies names several"),
    ],
)
def test_a_bad_file_is_named(change, words):
    with pytest.raises(InputError, match=words):
        make_spec({**KNOBS, **change}, "knobs.yaml")


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


def record(psnr, seconds=10.0, fps=50.0, jobs=1, splats=20):
    return {
        "machine": {"device": "a card", "torch": "2.11"},
        "jobs": jobs,
        "train": {"seconds": seconds, "parts": 1},
        "measured": {"test": {"psnr": psnr, "ssim": 0.9}, "fps": fps, "splats": splats, "parameter_bytes": 2e6},
    }


def row(name, *records):
    return Row("s", name, "own", dict(enumerate(records))).fill()


def test_differences_inside_the_noise_are_marked():
    """One deviation for all: pairs 0.2 apart have s = 0.1414, 3 degrees of freedom, so the bound is
    t(3) 0.1414 = 3.182 * 0.1414 = 0.450."""
    rows = [
        row("default", record(30.0), record(30.2)),
        row("near", record(30.4), record(30.6)),
        row("far", record(30.5), record(30.7)),
    ]
    result = changes(rows, rows[0], PSNR, ratio=False)
    assert result["near"].value == pytest.approx(0.4) and result["near"].is_noise
    assert result["far"].value == pytest.approx(0.5) and not result["far"].is_noise
    assert result["far"].noise == pytest.approx(0.4501, abs=1e-4)
    # One seed each: the spread is unknown.
    single = [row("default", record(30.0)), row("far", record(40.0))]
    assert changes(single, single[0], PSNR, ratio=False)["far"].is_noise


def test_costs_are_ratios_of_geometric_means():
    rows = [
        row("default", record(30.0, seconds=10.0), record(30.0, seconds=40.0)),
        row("half", record(30.0, seconds=5.0), record(30.0, seconds=20.0)),
        row("shared", record(30.0, jobs=2), record(30.0, jobs=2)),
    ]
    result = changes(rows, rows[0], BY_NAME["time s"], ratio=True)
    assert result["half"].value == pytest.approx(0.5)
    # The same spread, a factor of 4, in both: s = ln 4 / sqrt 2, 2 degrees of freedom, bound t(2) s = 4.303 * 0.980.
    assert result["half"].noise == pytest.approx(math.exp(4.3027 * math.log(4) / math.sqrt(2)), rel=1e-4)
    assert result["half"].is_noise and "shared" not in result  # its time was not measured alone
    rows = [row("default", record(30.0)), row("empty", record(5.0, splats=0))]
    assert set(changes(rows, rows[0], BY_NAME["splats"], ratio=True)) == {"default"}


def test_prices():
    def ratio(value):
        return Change(value, 1.05, True)

    up, down, nothing = Change(0.6, 0.1), Change(-0.6, 0.1), Change(0.05, 0.1)
    assert price(up, ratio(4.0)) == price(down, ratio(0.25)) == "0.30"
    assert price(up, ratio(0.25), power=-1) == "0.30"  # a quarter of the frames
    assert price(up, ratio(0.5)) == "better and cheaper" and price(down, ratio(2.0)) == "worse and more expensive"
    assert price(up, ratio(0.97)) == "gain, cost unclear" and price(down, ratio(1.0)) == "loss, cost unclear"
    assert price(nothing, ratio(2.0)) == "PSNR unclear" and price(nothing, ratio(1.02)) == "unclear"
