# SPDX-License-Identifier: Apache-2.0
"""What short trainings reach, from which the bounds of the tests follow that train so.

results/smoke.json: for each case the PSNR of trainings with several seeds, and that after one step.
"""

import json
from functools import cache
from pathlib import Path
from statistics import stdev
from typing import Any

FILE = Path(__file__).resolve().parents[2] / "results" / "smoke.json"
METHODS = "nrfgs", "nrfgs-sh", "nrfgs-vdgs", "nrfgs-gsnb", "nrfgs-sg"
STEPS = 300
PLAIN = {
    "--pipeline.model.num-downscales": 0,
    "--pipeline.model.few-views": "off",
    "--pipeline.model.shrinkage": 0,
}


@cache
def recorded() -> dict[str, dict[str, Any]]:
    """Case -> "psnr" of its trainings by seed, and "after_one_step", which learns nothing."""
    return json.loads(FILE.read_text(encoding="utf-8"))["records"]


def bound(case: str) -> float:
    """PSNR that a training of the case must exceed: four deviations below the least of those recorded.

    The deviation is over seeds, the largest of the cases on the same data set.
    """
    group = [one for name, one in recorded().items() if name.split("/")[0] == case.split("/")[0]]
    return min(recorded()[case]["psnr"]) - 4 * max(stdev(one["psnr"]) for one in group)


def gain_bound(scene: str) -> float:
    """Decibels by which the field must be above harmonics on a capture: four deviations below the least recorded."""
    field, harmonics = (recorded()[f"{scene}/{method}"]["psnr"] for method in ("nrfgs", "nrfgs-sh"))
    gains = [ours - theirs for ours, theirs in zip(field, harmonics, strict=True)]
    return min(gains) - 4 * stdev(gains)
