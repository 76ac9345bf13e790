# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export`: which file is written, and what about it can be chosen."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from nrfgs_ns.compact.options import CompactOptions
from nrfgs_ns.export.web.options import WebOptions
from nrfgs_ns.files import check_writable


@dataclass
class PlyOptions:
    """How splats lie in a PLY file."""

    world: Literal["viewers", "training", "capture"] = "viewers"
    """viewers: y points down, as the programs expect that open files of 3DGS. training: as it was trained, z up, and as
    ns-export writes it. capture: the data set's own axes and unit of length; of coordinates too large for float32 the
    file's header says what was subtracted"""
    steps: int | None = None
    """of the fine-tune that makes the file draw what the model draws, 0 for none. None: 2,500, on a CPU 400"""
    largest: float | None = None
    """cut the splats' standard deviations to this length, in the unit of the training's world, in which the cameras lie
    between -1 and 1: viewers that leave out what is centred off the screen do less harm. None: as trained"""


@dataclass
class Export:
    """Write a trained model as a file that other programs read."""

    format: tyro.conf.Positional[Literal["ply", "compact", "web"]]
    """ply: the format of 3D Gaussian Splatting, with spherical harmonics fitted to the colours. compact: the field
    itself in a small file, which ns-eval, ns-viewer and ns-render read (docs/compact-format.md). web: a page that runs
    the field in a browser (docs/web.md)"""
    load_config: Path
    """config.yml of the training"""
    output: Path
    """the file to write; an older one is replaced. web: a name that does not end in .html is a folder's, for a web
    server"""
    measure: bool = True
    """render the test views from the model and from the written file, and tell what the fit loses"""
    report: Path | None = None
    """also write the numbers to this file, as JSON"""
    ply: PlyOptions = field(default_factory=PlyOptions)
    """how splats lie in a PLY file"""
    compact: CompactOptions = field(default_factory=CompactOptions)
    """what a compact file may leave out, and the scene in a page"""
    web: WebOptions = field(default_factory=WebOptions)
    """what a page says of itself"""

    def main(self) -> None:
        if self.report is not None:
            check_writable(self.report, "--report")
        if self.format == "web":
            from nrfgs_ns.export.web.command import export_web

            export_web(self.load_config, self.output, self.compact, self.web, self.measure, self.report)
            return
        check_writable(self.output, "--output")
        if self.format == "compact":
            from nrfgs_ns.export.compact import export_compact

            export_compact(self.load_config, self.output, self.compact, self.measure, self.report)
        else:
            from nrfgs_ns.export.ply import export_ply

            export_ply(self.load_config, self.output, self.ply, self.measure, self.report)
