# SPDX-License-Identifier: Apache-2.0
"""Frames per second of trained models, in turns, at the photographs' size and at 1080p.

    python -m nrfgs_lab.timing.frames FIELD/config.yml HARMONICS/config.yml --rounds 5 --out frames.json

All models are in memory at once. In each round each of them renders its test cameras, so that a machine that changes
its speed hurts all alike; a table shows medians and ranges.
"""

import json
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from nerfstudio.utils.eval_utils import eval_setup
from rich.console import Console
from rich.table import Table

from nrfgs_lab.bench.measure import FULL_HD, at_size, frames_per_second
from nrfgs_ns.training.run import machine


@dataclass
class Frames:
    """Which models, and how often."""

    configs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """config.yml of each training; its last checkpoint is rendered"""
    out: Path
    """JSON file of the results"""
    rounds: int = 5
    """turns of each model"""

    @torch.no_grad()
    def main(self) -> None:
        models = []
        for config in self.configs:
            trained, pipeline, _, _ = eval_setup(config)
            model = pipeline.model.eval()
            own = [camera for camera, _ in pipeline.datamanager.fixed_indices_eval_dataloader]
            sizes = {"own": own, "1080p": [at_size(camera, *FULL_HD) for camera in own]}
            models.append((trained.method_name, model, sizes))
        rows: list[dict[str, Any]] = []
        for turn in range(self.rounds):
            for name, model, sizes in models:
                fps = {size: frames_per_second(model, cameras) for size, cameras in sizes.items()}
                rows.append({"method": name, "splats": int(model.num_points), "round": turn, "fps": fps})
                print(rows[-1], file=sys.stderr)
                self.out.parent.mkdir(parents=True, exist_ok=True)
                self.out.write_text(json.dumps({"machine": machine(), "runs": rows}, indent=1) + "\n")
        report(rows)


def report(rows: list[dict[str, Any]]) -> None:
    """Print medians and ranges over rounds."""
    table = Table("method", "splats", *rows[0]["fps"])
    for name, splats in dict.fromkeys((row["method"], row["splats"]) for row in rows):
        mine = [row["fps"] for row in rows if (row["method"], row["splats"]) == (name, splats)]
        cells = [[fps[size] for fps in mine] for size in mine[0]]
        shown = (f"{statistics.median(cell):.0f} ({min(cell):.0f} to {max(cell):.0f})" for cell in cells)
        table.add_row(name, f"{splats:,}", *shown)
    Console(width=120).print(table)


if __name__ == "__main__":
    tyro.cli(Frames).main()
