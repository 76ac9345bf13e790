# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export FORMAT`."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nrfgs_ns.errors import InputError
from nrfgs_ns.export.options import SCENE, CompactOptions, PlyOptions, WebOptions
from nrfgs_ns.files import check_writable
from nrfgs_ns.trained.find import NamesTraining

FLAT = tyro.conf.arg(name="")
"""A group of options without a prefix."""


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

    options: Annotated[PlyOptions, FLAT] = field(default_factory=PlyOptions)

    def main(self) -> None:
        config = self.checked(self.output)
        if self.options.steps is not None and self.options.steps < 0:
            raise InputError(f"--steps is {self.options.steps}; it must be at least 0.")
        from nrfgs_ns.export.ply import export_ply

        export_ply(config, self.output, self.options, self.measure, self.report)


@dataclass
class Compact(_Format):
    """The field itself in a small file, for nrfgs view, ns-eval, ns-viewer and ns-render (docs/compact-format.md)."""

    options: Annotated[CompactOptions, FLAT] = field(default_factory=CompactOptions)

    def main(self) -> None:
        config = self.checked(self.output)
        check_compact(self.options)
        from nrfgs_ns.export.compact import export_compact

        export_compact(config, self.output, self.options, self.measure, self.report)


@dataclass
class Web(_Format):
    """A page that runs the field in a browser (docs/web.md): a file, or, unless --output ends in .html, a folder."""

    options: Annotated[CompactOptions, FLAT] = field(default_factory=CompactOptions)
    page: Annotated[WebOptions, FLAT] = field(default_factory=WebOptions)

    def main(self) -> None:
        alone = self.output.suffix.lower() in (".html", ".htm")
        if self.output.exists() and self.output.is_file() != alone:
            kind = "file" if self.output.is_file() else "folder"
            fix = "Name a file that ends in .html, or a folder that does not."
            raise InputError(f"--output {self.output} is a {kind}. {fix}")
        config = self.checked(*([self.output] if alone else [self.output / name for name in ("index.html", SCENE)]))
        check_compact(self.options)
        from nrfgs_ns.export.web.command import export_web

        export_web(config, self.output, self.options, self.page, self.measure, self.report)


def check_compact(options: CompactOptions) -> None:
    for name in ("finetune", "rate"):
        if not (value := getattr(options, name)) >= 0:
            raise InputError(f"--{name} is {value}; it must be zero or positive.")
    if options.size_mb is not None and not 0 < options.size_mb < math.inf:
        raise InputError(f"--size-mb is {options.size_mb}; it must be positive, in millions of bytes.")


@dataclass
class Export:
    """Write a trained model as a file that other programs read."""

    format: tyro.conf.OmitSubcommandPrefixes[Ply | Compact | Web]
    """the file's format"""

    def main(self) -> None:
        self.format.main()
