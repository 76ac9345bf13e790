# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/captures.md."""

from nrfgs_lab import held_out
from nrfgs_lab.pages.tables import ROOT


def gains() -> str:
    """What each trial gains over harmonics on held-out training views."""
    _, table = held_out.report(ROOT / "results" / "held-out.json").split("\n\n")
    return table


def test_views() -> str:
    """What trainings at full size have on test views."""
    return held_out.test_views(ROOT / "results" / "captures.json")
