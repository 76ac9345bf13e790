# SPDX-License-Identifier: Apache-2.0
"""Hostile inputs are refused with one clear sentence (see `attempt`), whatever is wrong with them. `table.py` runs more
of them and prints the table of docs/troubleshooting.md."""

import json
import os
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parent))

from attempt import GOOD, Case, attempts  # noqa: E402
from table import areas  # noqa: E402

AREAS = {area.AREA: area for area in areas()}


@pytest.mark.parametrize("area", AREAS)
def test_every_input_of_the_list(area):
    cases = AREAS[area].CASES
    outcomes = list(zip(cases, attempts(cases), strict=True))
    assert not {case.name: outcome for case, outcome in outcomes if outcome.kind not in GOOD}
    assert not {case.name: outcome for case, outcome in outcomes if not all(word in outcome.said for word in case.says)}


@pytest.mark.parametrize("area", AREAS)
@settings(max_examples=10, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_inputs_that_nobody_thought_of(area, data):
    case = data.draw(AREAS[area].inputs())
    (outcome,) = attempts([case])
    assert outcome.kind in GOOD, (case.name, outcome)


def test_the_attack_tells_outcomes_apart():
    def case(act, hostile=True):
        return Case("", lambda folder: lambda: act(folder), hostile)

    def refuse(message):
        from nrfgs_ns.errors import InputError

        raise InputError(message)

    cases = {
        case(lambda folder: refuse("x: is wrong. Mend it.")): "refused",
        case(lambda folder: refuse("x:\nis wrong")): "unclear",
        case(lambda folder: 1 / 0): "traceback",
        case(lambda folder: sys.exit(1)): "traceback",
        case(lambda folder: None): "silent",
        case(lambda folder: os._exit(1)): "hang",
        case(lambda folder: None, hostile=False): "read",
        case(lambda folder: (folder / "x").touch(), hostile=False): "wrote",
        case(lambda folder: bytearray(2**30 + 2**28).count(1), hostile=False): "large",
        case(lambda folder: [abs(i) for i in range(10**9)], hostile=False): "slow",
        Case("", lambda folder: 1 / 0): "broken case",
    }
    assert [outcome.kind for outcome in attempts(list(cases))] == list(cases.values())


def test_the_record_is_of_these_areas_and_nothing_got_through():
    record = json.loads((Path(__file__).resolve().parents[2] / "results" / "attack.json").read_text())["after"]
    assert set(record["areas"]) <= set(AREAS)
    assert all(not area["did not hold"] for area in record["areas"].values())
