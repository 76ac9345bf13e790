# SPDX-License-Identifier: Apache-2.0
"""Options of a training on several devices."""

from dataclasses import dataclass
from typing import Literal


@dataclass
class ShardingConfig:
    """How the splats are spread over the devices, and what a step counts. Nothing of it is read with one device."""

    rebalance_at: float = 1.1
    """splats move between devices once one has more than this many times the mean; looked at after each refinement"""
    schedules: Literal["steps", "images"] = "steps"
    """what step numbers and learning rates mean. steps: what they say; each step sees one image for each device.
    images: they are written for one device, and a training sees as many images as it would there, in fewer steps: all
    step numbers are divided by the number of devices, and Adam takes larger steps (docs/many-gpus.md)"""
