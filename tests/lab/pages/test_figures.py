# SPDX-License-Identifier: Apache-2.0
"""The figures of the pages are those of the records."""

import pytest

from nrfgs_lab.pages.figures import FIGURES
from nrfgs_lab.pages.runs import ROOT


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_that_of_the_records(name):
    assert FIGURES[name]() == (ROOT / "docs" / "images" / name).read_text(encoding="utf-8")
