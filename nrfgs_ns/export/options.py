# SPDX-License-Identifier: Apache-2.0
"""Options of the three formats, which are read before torch is imported."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SCENE = "scene.nrf"
"""Name of the scene's file in a page's folder."""


@dataclass
class PlyOptions:
    """Options of a PLY file."""

    world: Literal["viewers", "training", "capture"] = "viewers"
    """viewers: y points down, as viewers of 3DGS files expect. training: z points up, as in training and in ns-export's
    files. capture: the data set's own axes and unit of length; from coordinates too large for float32 an origin is
    subtracted, which the file's header tells"""
    steps: int | None = None
    """steps of the fine-tune towards the model's images. None: 2,500; on a CPU 10 for each training view, at most
    400"""


@dataclass
class CompactOptions:
    """How a compact file is made smaller."""

    finetune: int = 0
    """steps of a fine-tune for the file: tables that cost less, learnt rounding. 0: the model's numbers, rounded"""
    rate: float = 1e-4
    """with finetune: the training's loss that one byte for each splat is worth. More: a smaller file"""
    size_mb: float | None = None
    """millions of bytes that the output may have: it becomes as precise as that allows. With finetune the rate is
    found while it trains, and rate is where it begins"""


@dataclass
class WebOptions:
    """What a page says, and what it does by itself until the first touch."""

    title: str | None = None
    """heading of the page. None: the output's name"""
    author: str = ""
    """a line below the heading"""
    tour: tuple[str, ...] = ()
    """a tour: two or more photographs by number or name, or one JSON file, saved in a page or by nerfstudio's viewer"""
    rotate: bool = False
    """without a tour: turn slowly around the subject"""
    notes: Path | None = None
    """JSON file of notes at points of the scene, as a page saves it"""
    address: str | None = None
    """where the page will be, https://...: writes a picture beside it, which is shown where the address is shared"""
