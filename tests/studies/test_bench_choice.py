# SPDX-License-Identifier: Apache-2.0
"""What a command line chooses of a benchmark's file."""

import pytest

from nrfgs_ns.errors import InputError
from nrfgs_ns.studies.bench import Bench
from nrfgs_ns.studies.bench_choice import named_run
from nrfgs_ns.studies.bench_spec import cells_of, identity

FILE = """
runs:
  no split: {method: nrfgs, options: --x False, steps: 9}
  NRF-GS: nrfgs
  nrfgs-sh: {method: nrfgs-sh, options: --degree 1}
  5: nrfgs-vdgs
scenes: [{path: garden, downscale: 4}, other]
"""


@pytest.fixture
def file(tmp_path):
    """The file above."""
    (tmp_path / "spec.yaml").write_text(FILE)
    return tmp_path / "spec.yaml"


def test_runs_are_chosen_by_name(file):
    """A run of the file, with its options; else a method. A name that is both is the file's."""

    def runs(*words):
        return [(run.name, run.method, run.options, run.steps) for run in Bench(spec=file, runs=words).plan().runs]

    assert runs("no split", "NRF-GS") == [("no split", "nrfgs", ("--x", "False"), 9), ("NRF-GS", "nrfgs", (), None)]
    assert runs("nrfgs-sh", "5") == [("nrfgs-sh", "nrfgs-sh", ("--degree", "1"), None), ("5", "nrfgs-vdgs", (), None)]
    assert runs("nrfgs", "nrfgs-sg --y 1") == [
        ("nrfgs", "nrfgs", (), None),
        ("nrfgs-sg --y 1", "nrfgs-sg", ("--y", "1"), None),
    ]
    assert runs("no split=nrfgs --x True") == [("no split", "nrfgs", ("--x", "True"), None)]
    listed = "no method of ns-train.*has no run of that name.*no split, NRF-GS, nrfgs-sh, 5"
    for words in ("no opacity", "NRF-GSS", "a=nrf"):
        with pytest.raises(InputError, match=listed):
            runs("NRF-GS", words)
    with pytest.raises(InputError, match="'nrgs' is no method of ns-train. Give"):
        Bench(runs=("nrgs",), data=("x",)).plan()
    assert [run.method for run in Bench(runs=("splatfacto",), data=("x",)).plan().runs] == ["splatfacto"]


def test_a_chosen_run_is_the_one_of_the_whole_file(file):
    whole, part = Bench(spec=file).plan(), Bench(spec=file, runs=("no split",), data=("garden",)).plan()
    (cell,) = cells_of(part)
    assert cell == cells_of(whole)[0] and cell.scene.downscale == 4
    assert identity(part, cell, None) == identity(whole, cell, None)


def test_runs_on_the_command_line_may_have_names_with_spaces_and_options_with_equals():
    assert named_run("nrfgs-sh") == ("nrfgs-sh", {"method": "nrfgs-sh", "options": ""})
    named = ("NRF-GS logit", {"method": "nrfgs", "options": "--pipeline.model.appearance.opacity-bound=logit"})
    assert named_run("NRF-GS logit=nrfgs --pipeline.model.appearance.opacity-bound=logit") == named
    plain = "nrfgs --machine.seed=3"
    assert named_run(plain) == (plain, {"method": "nrfgs", "options": "--machine.seed=3"})
