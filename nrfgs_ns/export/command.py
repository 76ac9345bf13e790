# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export FORMAT`: its options, which are read before torch is imported."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from nrfgs_ns.errors import InputError, require
from nrfgs_ns.files import check_writable
from nrfgs_ns.trained.command import NamesTraining

SCENE = "scene.nrf"
"""Name of the scene's file in a page's folder."""


@dataclass
class _Format(NamesTraining):
    """Options of all formats."""

    output: Path = field(kw_only=True)
    """the file to write; an older one is replaced"""
    measure: bool = True
    """render the test views from the model and from the written file, and print the difference"""
    report: Path | None = None
    """also write the numbers to this file, as JSON"""

    def checked(self, *files: Path) -> Path:
        """The config.yml; paths that are written at the end are checked, the format's `files` among them."""
        config = self.config()
        taken = {config.resolve(): "the training's file"}
        for option, path in (("--report", self.report), *(("--output", file) for file in files)):
            if path is not None:
                check_writable(path, option)
                if (other := taken.setdefault(path.resolve(), option)) != option:
                    raise InputError(f"{option} {path} would replace {other}. Give each a name of its own.")
        return config


@dataclass
class Ply(_Format):
    """The format of 3D Gaussian Splatting, with spherical harmonics fitted to the colours."""

    world: Literal["viewers", "training", "capture"] = "viewers"
    """viewers: y points down, as viewers of 3DGS files expect. training: z points up, as in training and in ns-export's
    files. capture: the data set's own axes and unit of length; from coordinates too large for float32 an origin is
    subtracted, which the file's header tells"""
    steps: int | None = None
    """steps of the fine-tune towards the model's images. None: 2,500; on a CPU 10 for each training view, at most
    400"""

    def main(self) -> None:
        config = self.checked(self.output)
        require(self.steps is None or self.steps >= 0, "--steps", self.steps, "at least 0")
        from nrfgs_ns.export.ply import export_ply

        export_ply(config, self)


@dataclass
class Compact(_Format):
    """The field itself in a small file, for nrfgs view, ns-eval, ns-viewer and ns-render (docs/compact-format.md)."""

    finetune: int = 0
    """steps of a fine-tune for the file: tables that cost less, learnt rounding. 0: the model's numbers, rounded"""
    rate: float = 1e-4
    """with finetune: the training's loss that one byte for each splat is worth. More: a smaller file"""
    size_mb: float | None = None
    """millions of bytes that the output may have: it becomes as precise as that allows. With finetune the rate is
    found while it trains, and rate is where it begins"""

    def checked(self, *files: Path) -> Path:
        for name, value in (("--finetune", self.finetune), ("--rate", self.rate)):
            require(value >= 0, name, value, "zero or positive")
        size = self.size_mb
        require(size is None or 0 < size < math.inf, "--size-mb", size, "positive, in millions of bytes")
        return super().checked(*files)

    def main(self) -> None:
        config = self.checked(self.output)
        from nrfgs_ns.export.compact import export_compact

        export_compact(config, self)


@dataclass
class Web(Compact):
    """A page that runs the field in a browser (docs/web.md): a file, or, unless --output ends in .html, a folder."""

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

    @property
    def alone(self) -> bool:
        """Whether the page is one file with the scene in it."""
        return self.output.suffix.lower() in (".html", ".htm")

    @property
    def picture(self) -> Path:
        """The picture that `address` asks for."""
        return self.output.with_suffix(".preview.jpg") if self.alone else self.output / "preview.jpg"

    def main(self) -> None:
        if self.output.exists() and self.output.is_file() != self.alone:
            kind = "file" if self.output.is_file() else "folder"
            fix = "Name a file that ends in .html, or a folder that does not."
            raise InputError(f"--output {self.output} is a {kind}. {fix}")
        files = [self.output] if self.alone else [self.output / "index.html", self.output / SCENE]
        files += [] if self.address is None else [self.picture]
        config = self.checked(*files)
        from nrfgs_ns.export.web.command import export_web

        export_web(config, self)


@dataclass
class Export:
    """Write a trained model as a file that other programs read."""

    format: tyro.conf.OmitSubcommandPrefixes[Ply | Compact | Web]
    """the file's format"""

    def main(self) -> None:
        self.format.main()
