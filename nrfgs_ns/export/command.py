# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export FORMAT`."""

from dataclasses import dataclass

import tyro

from nrfgs_ns.errors import InputError
from nrfgs_ns.export.options import SCENE, CompactOptions, PlyOptions, WebOptions


@dataclass
class Ply(PlyOptions):
    """The format of 3D Gaussian Splatting, with spherical harmonics fitted to the colours."""

    def main(self) -> None:
        if self.steps is not None and self.steps < 0:
            raise InputError(f"--steps is {self.steps}; it must be at least 0.")
        config = self.checked(self.output)
        from nrfgs_ns.export.ply import export_ply

        export_ply(config, self)


@dataclass
class Compact(CompactOptions):
    """The field itself in a small file, for nrfgs view, ns-eval, ns-viewer and ns-render (docs/compact-format.md)."""

    def main(self) -> None:
        config = self.checked(self.output)
        from nrfgs_ns.export.compact import export_compact

        export_compact(config, self)


@dataclass
class Web(WebOptions):
    """A page that runs the field in a browser (docs/web.md): a file, or, unless --output ends in .html, a folder."""

    def main(self) -> None:
        if self.output.exists() and self.output.is_file() != self.is_alone:
            kind = "file" if self.output.is_file() else "folder"
            fix = "Name a file that ends in .html, or a folder that does not."
            raise InputError(f"--output {self.output} is a {kind}. {fix}")
        files = [self.output] if self.is_alone else [self.output / name for name in ("index.html", SCENE)]
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
