# SPDX-License-Identifier: Apache-2.0
"""The command that gives a good result in ten minutes without a CUDA device. No nerfstudio here: it is asked early."""

import shlex
from pathlib import Path

TEN_MINUTES = ("--time-budget", "10", "--pipeline.datamanager.camera-res-scale-factor", "0.25")
"""Options that give a good result in ten minutes on two CPU cores (docs/measurements.md)."""


def ten_minute_command(data: Path) -> str:
    """What to type for the data set in a folder."""
    return shlex.join(["ns-train", "nrfgs-fast", "--data", str(data), *TEN_MINUTES])
