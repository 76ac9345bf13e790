# SPDX-License-Identifier: Apache-2.0
"""docs/options.md says what the configurations say, and the command line knows what it says."""

import contextlib
import dataclasses
import io
import re

import pytest

from nrfgs_lab.pages.options import PAGE, command_options, methods, own_options, page
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.cli import commands
from nrfgs_ns.training.run import parse


def test_the_page_is_current():
    assert PAGE.read_text(encoding="utf-8") == page(), "write it again: python -m nrfgs_lab.pages.options"


def test_every_option_is_explained():
    options = [option for method in methods() for option in own_options(method.config)]
    options += [option for one in commands().values() for option in command_options(one.load())]
    assert len(options) > 100
    assert [option.flag for option in options if not option.text] == []
    flags = {option.flag for option in own_options(methods()[0].config)}
    fields = {field.name.replace("_", "-") for field in dataclasses.fields(NrfConfig) if field.name[0] != "_"}
    assert {f"pipeline.model.appearance.{name}" for name in fields} <= flags
    assert "time-budget" in flags and "pipeline.model.densification" in flags
    assert not any("sh-degree" in flag or "num-downscales" in flag for flag in flags)  # suppressed; splatfacto's


def test_a_switch_that_is_on_is_named_as_the_default_and_the_text_mean_it():
    """`--no-measure`, True, "render and tell" would say the opposite of what the switch does."""
    measure = next(option for option in command_options(commands()["export"].load()) if "measure" in option.flag)
    assert (measure.flag, measure.default) == ("--measure, --no-measure", True)
    assert (
        next(option for option in command_options(commands()["demo"].load()) if "quick" in option.flag).flag
        == "--quick"
    )


@pytest.mark.parametrize("words", [["nrfgs"], ["nrfgs", "nrfgs-data"]])
def test_the_command_line_has_them(words):
    screen = io.StringIO()
    with contextlib.redirect_stdout(screen), pytest.raises(SystemExit):
        parse([*words, "--help"])
    known = set(re.findall(r"--([\w.-]+)", screen.getvalue()))
    for option in own_options(methods()[0].config):
        inner = option.flag.split(".dataparser.")
        if len(inner) == len(words):  # the data set's options come after its word
            assert inner[-1].lower() in {flag.lower() for flag in known}, option.flag
