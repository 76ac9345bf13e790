# SPDX-License-Identifier: Apache-2.0
"""The command that gives a result in ten minutes without a CUDA device. No nerfstudio here: it is asked early."""

import json
import shlex
from pathlib import Path

LONGEST_SIDE = 240
"""Pixels to which photographs are made smaller: as many as two CPU cores train on in minutes."""


def ten_minute_command(data: Path) -> str:
    """The command for the data set in a folder, or for its transforms.json."""
    words = ["ns-train", "nrfgs-fast", "--data", str(data), "--time-budget", "10"]
    return shlex.join([*words, "--pipeline.datamanager.camera-res-scale-factor", f"{scale_for(data):g}"])


def scale_for(data: Path) -> float:
    """Factor from a data set's photographs to `LONGEST_SIDE`, at most 1; 0.25 where their size is unknown."""
    source = data if data.suffix == ".json" else data / "transforms.json"
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
        first = {**content["frames"][0], **content}
        longest = max(int(first["w"]), int(first["h"]))
        return min(1.0, float(f"{LONGEST_SIDE / longest:.2g}"))
    except (OSError, ValueError, LookupError, TypeError, ZeroDivisionError):  # the training says what is wrong
        return 0.25
