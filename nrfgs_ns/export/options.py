# SPDX-License-Identifier: Apache-2.0
"""Options of the three formats. Imports next to nothing: they are read before torch is imported."""

from dataclasses import dataclass
from typing import Literal


@dataclass
class PlyOptions:
    """How splats lie in a PLY file."""

    world: Literal["viewers", "training", "capture"] = "viewers"
    """viewers: y points down, as the programs expect that open files of 3DGS. training: as it was trained, z up, and as
    ns-export writes it. capture: the data set's own axes and unit of length; of coordinates too large for float32 the
    file's header says what was subtracted"""
    steps: int | None = None
    """of the fine-tune that makes the file draw what the model draws, 0 for none. None: 2,500; on a CPU 10 for each
    training view, at most 400"""
    largest: float | None = None
    """cut the splats' standard deviations to this length, in the unit of the training's world, in which the cameras lie
    between -1 and 1: viewers that leave out what is centred off the screen do less harm. None: as trained"""


@dataclass
class CompactOptions:
    """How a compact file is made smaller."""

    finetune: int = 0
    """steps of a fine-tune for the file: tables that cost less, learnt rounding. 0: the model's numbers, rounded"""
    rate: float = 1e-4
    """with finetune: the training's loss that one byte for each splat is worth. More: a smaller file"""


@dataclass
class WebOptions:
    """What a page says of itself."""

    title: str | None = None
    """heading of the page. None: the output's name"""
    author: str = ""
    """a line below the heading"""
