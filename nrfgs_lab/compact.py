# SPDX-License-Identifier: Apache-2.0
"""Bytes against dB of a capture's files: results/compact.json.

    python -m nrfgs_lab.compact SCENES/bonsai OUT         # the same for goldcape and fox; a GPU
    python -m nrfgs_lab.compact SCENES/fox OUT --rates --others ply                            # a PLY file alone
    python -m nrfgs_lab.results pack OUT results/compact.json
    python -m nrfgs_lab.pages.tables.files                # the figure

It trains the capture, and exports compact files fine-tuned at each of --rates, and --others, unless OUT has their
records. PSNR is of files read back, on test views. Records named after a setting (WORTH=0.5) were made with another
value of that constant of nrfgs_ns/compact/finetune.py or nrfgs_ns/model/harmonics_tune.py, on held-out views.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from nrfgs_lab.training_run import machine, train
from nrfgs_ns.export.options import CompactOptions, PlyOptions
from nrfgs_ns.files import write_whole


@dataclass
class Trade:
    """Bytes against dB of one capture."""

    data: Annotated[Path, tyro.conf.Positional]
    """the capture"""
    out: Annotated[Path, tyro.conf.Positional]
    """folder for the records"""
    work: Path = Path("outputs/compact")
    """folder for the training and the files"""
    rates: tuple[float, ...] = (1e-4, 3e-4, 5e-4, 1e-3, 2e-3)
    """rates of the fine-tunes"""
    steps: int = 4000
    """steps of each fine-tune"""
    others: tuple[Literal["ply", "plain"], ...] = ("ply", "plain")
    """files without a fine-tune: a PLY, a compact file"""

    def main(self) -> None:
        from nrfgs_ns.export.compact import export_compact
        from nrfgs_ns.export.ply import export_ply

        files = self.work / "files"
        files.mkdir(parents=True, exist_ok=True)
        config = Path(self.record("model", self.trained)["train"]["config_path"])

        def compact(options: CompactOptions) -> Callable[[Path], None]:
            return lambda report: export_compact(config, files / f"{report.stem}.nrf", options, True, report)

        for rate in self.rates:
            self.record(f"rate-{rate:g}", compact(CompactOptions(finetune=self.steps, rate=rate)))
        if "ply" in self.others:
            ply = files / f"{self.data.name}.ply"
            self.record("ply", lambda report: export_ply(config, ply, PlyOptions(), True, report))
        if "plain" in self.others:
            self.record("version-2", compact(CompactOptions()))

    def record(self, name: str, make: Callable[[Path], dict[str, Any] | None]) -> dict[str, Any]:
        """Record of a name; `make` returns it, or writes it to its argument."""
        path = self.out / f"{self.data.name}-{name}.json"
        if not path.exists() and (made := make(path)) is not None:
            write_whole(path, json.dumps(made, indent=1) + "\n")
        return json.loads(path.read_text(encoding="utf-8"))

    def trained(self, _: Path) -> dict[str, Any]:
        """The record of the training."""
        args = ["nrfgs", "--data", str(self.data), "--output-dir", str(self.work), "--machine.seed", "42"]
        args += ["--vis", "tensorboard", "--steps-per-eval-all-images", "1000000"]
        return {"machine": machine(), "train": asdict(train([*args, "nrfgs-data"]))}


if __name__ == "__main__":
    tyro.cli(Trade).main()
