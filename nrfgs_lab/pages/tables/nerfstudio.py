# SPDX-License-Identifier: Apache-2.0
"""The table of docs/nerfstudio/nrfgs.md."""

from nrfgs_lab.pages.tables import grid
from nrfgs_lab.pages.tables.speed import of_training

METHODS = {
    "nrfgs": "the method",
    "nrfgs-sh": "the same model with spherical harmonics (3DGS)",
    "splatfacto": "nerfstudio's own, for comparison",
}


def methods() -> str:
    """Memory and time of the methods on bonsai."""
    body = [
        [f"`{name}`", text, f"{float(of_training('peak MB', name)) / 1000:.1f} GB", f"{of_training('time s', name)} s"]
        for name, text in METHODS.items()
    ]
    return grid(["method", "description", "memory (bonsai, 799 x 532)", "time for 30,000 steps (H200)"], body)
