# SPDX-License-Identifier: Apache-2.0
"""What a command line chooses of a benchmark's file."""

import pytest

from nrfgs_lab.bench.choice import named_run, united, with_records
from nrfgs_lab.bench.command import Bench
from nrfgs_lab.bench.spec import cells_of, identity, make_spec
from nrfgs_ns.errors import InputError

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


def test_everything_of_a_file_and_what_is_asked_for():
    """What is asked for comes behind the file's, in place of what has its name; the rest is the command's."""
    file = {"runs": {"a": "nrfgs", 5: "nrfgs-sh"}, "scenes": [{"path": "s/", "downscale": 2}, "t"], "steps": 9}
    asked = {"runs": {"a": "nrfgs-sg", "b": "nrfgs"}, "scenes": ["u", {"path": "s", "downscale": 2}], "steps": 3}
    both = united(file, asked)
    assert both["runs"] == {"a": "nrfgs-sg", "5": "nrfgs-sh", "b": "nrfgs"} and list(both["runs"]) == ["a", "5", "b"]
    assert both["scenes"] == [{"path": "s", "downscale": 2}, "t", "u"]
    assert both["steps"] == 3 and "seeds" not in both and "protocols" not in both
    # A file without seeds or protocols has the defaults of a benchmark.
    more = united(file, {**asked, "seeds": [7, 42], "protocols": ["mcmc"]})
    assert more["seeds"] == [42, 7] and more["protocols"] == ["own", "mcmc"]
    more = united({**file, "seeds": 1, "protocols": "original"}, {**asked, "seeds": [7], "protocols": ["mcmc"]})
    assert more["seeds"] == [1, 7] and more["protocols"] == ["original", "mcmc"]
    assert united({}, asked) == asked


def test_scenes_are_chosen_however_their_path_is_written(file):
    (scene,) = Bench(spec=file, data=("./garden/",)).plan().scenes
    assert (scene.name, scene.downscale) == ("garden", 4)


def test_a_report_has_what_is_asked_for_and_what_is_there():
    content = {
        "runs": {"a": "nrfgs", "b": "nrfgs", "c": "nrfgs"},
        "scenes": ["s", "t", "u"],
        "protocols": ["splatfacto", "original", "mcmc"],
        "seeds": [1, 2, 3],
    }
    whole = make_spec(content, "file")
    asked = make_spec({"runs": {"b": "nrfgs"}, "scenes": "t", "protocols": "original", "seeds": 2}, "file")

    def shown(*there):
        spec = with_records(whole, asked, lambda name: name in there)
        return [run.name for run in spec.runs], [one.name for one in spec.scenes], spec.protocols, spec.seeds

    assert shown() == (["b"], ["t"], ["original"], [2])
    (name,) = (
        cell.name
        for cell in cells_of(whole)
        if (cell.run.name, cell.scene.name) == ("c", "s") and (cell.protocol, cell.seed) == ("mcmc", 1)
    )
    assert shown(name) == (["b", "c"], ["s", "t"], ["original", "mcmc"], [1, 2])


def test_runs_on_the_command_line_may_have_names_with_spaces_and_options_with_equals():
    assert named_run("nrfgs-sh") == ("nrfgs-sh", {"method": "nrfgs-sh", "options": ""})
    named = ("NRF-GS logit", {"method": "nrfgs", "options": "--pipeline.model.appearance.opacity-bound=logit"})
    assert named_run("NRF-GS logit=nrfgs --pipeline.model.appearance.opacity-bound=logit") == named
    plain = "nrfgs --machine.seed=3"
    assert named_run(plain) == (plain, {"method": "nrfgs", "options": "--machine.seed=3"})
