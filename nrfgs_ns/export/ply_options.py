# SPDX-License-Identifier: Apache-2.0
"""Options of `nrfgs export ply`. Imports next to nothing: `nrfgs --help` reads it."""

from dataclasses import dataclass
from typing import Literal


@dataclass
class PlyOptions:
    """How splats lie in a PLY file."""

    world: Literal["viewers", "training", "capture"] = "viewers"
    """viewers: y points down, as the programs expect that open files of 3DGS. training: as it was trained, z up, and as
    ns-export writes it. capture: the data set's own axes and unit of length; of coordinates too large for float32 the
    file's header says what was subtracted"""
    largest: float | None = None
    """cut the splats' standard deviations to this length, in the unit of the training's world, in which the cameras lie
    between -1 and 1: viewers that leave out what is centred off the screen do less harm. None: as trained"""
