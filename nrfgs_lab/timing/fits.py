# SPDX-License-Identifier: Apache-2.0
"""What fits on a card: trainings within the memory of smaller cards, and what a million splats take, by part.

    python -m nrfgs_lab.timing.fits --out fits.jsonl --data SCENE \\
        --options="--pipeline.model.densification error-guided,threshold=0.0005,most_splats=10000000"

Each training and each number of splats is a line of JSON in the file `out`; those there are skipped. A card of 12 GB is
a process that may take 12 GB, CUDA's own part included. The difference of two numbers of splats is what splats take.
"""

import gc
import shlex
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro

from nrfgs_lab.bench.run import host_without_downloads
from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.timing.scale import Stopwatch, add_line, at_megapixels, lines_of, made, trained
from nrfgs_lab.training_run import evaluate, train

KEY = "what", "method", "of"


@dataclass
class Fits:
    """Trainings and tables of splats, each a line of JSON in the file `out`."""

    out: Path
    data: Path  # the data set that is trained on
    method: str = "nrfgs-best"
    options: str = ""  # further words of the training's command
    gigabytes: tuple[float, ...] = (8.0, 12.0, 24.0)  # of cards
    splats: tuple[int, ...] = (1_000_000, 2_000_000)  # for the parts
    megapixels: float = 2.0  # of the images, for the parts
    methods: tuple[str, ...] = ("nrfgs", "nrfgs-sh", "splatfacto")  # for the parts

    def main(self) -> None:
        records = lines_of(self.out)
        done = [[record[key] for key in KEY] for record in records]
        method = f"{self.method} {self.options}".strip()
        cells = [("parts", of, count) for of in self.methods for count in self.splats]
        for cell in [*cells, *(("training", method, size) for size in self.gigabytes)]:
            if list(cell) in done:
                continue
            measured = partial(self.parts, *cell[1:]) if cell[0] == "parts" else partial(self.training, cell[2])
            add_line(self.out, records, dict(zip(KEY, cell, strict=True)), measured)

    def training(self, gigabytes: float) -> dict[str, Any]:
        """Cost and quality of a training in a process that may take so much."""
        limit(gigabytes)
        folder = self.out.with_suffix("") / f"{gigabytes:g}"
        words = [self.method, "--data", self.data, "--output-dir", folder, *QUIET, *shlex.split(self.options)]
        with host_without_downloads(self.method):
            cost = train([str(word) for word in words])
            scores = evaluate(cost.config_path, folder / "eval.json")
        held = torch.cuda.max_memory_reserved() if torch.cuda.is_available() else 0
        record = {"seconds": cost.seconds, "steps": cost.steps, "splats": cost.splats[-1][1], "held_mb": held / 1e6}
        return record | {"peak_mb": (cost.peak_memory_bytes or 0) / 1e6, "psnr": scores["psnr"], "ssim": scores["ssim"]}

    def parts(self, method: str, count: int) -> dict[str, Any]:
        """Megabytes of so many splats in training: their tensors' sizes, and what is free when these are gone."""
        watch = Stopwatch(1)
        device = "cuda" if torch.cuda.is_available() else "cpu"
        trainer = trained(method, at_megapixels(made(count), self.megapixels), device, watch)
        model, optimizers = trainer.pipeline.model, trainer.optimizers
        states = {name: optimizers.optimizers[name].state for name in model.gauss_params}
        moments = [v for name, splats in model.gauss_params.items() for v in states[name][splats].values() if v.dim()]
        sizes = {"peak": watch.peak_bytes, "parameters": sum(splats.nbytes for splats in model.gauss_params.values())}
        sizes["moments"] = sum(value.nbytes for value in moments)
        del moments

        def forget_step() -> None:
            trainer.graphs = None
            model.info, model.watched = {}, {}

        for name, forget in {
            "step": forget_step,
            "gradients": optimizers.zero_grad_all,
            "moments": lambda: [state.clear() for state in states.values()],
        }.items():
            before = torch.cuda.memory_allocated()
            forget()
            gc.collect()
            sizes[f"without_{name}"] = before - torch.cuda.memory_allocated()
        return {f"{name}_mb": size / 1e6 for name, size in sizes.items()}


def limit(gigabytes: float) -> None:
    """Let this process take no more of the GPU than it could of a card with so much memory."""
    if torch.cuda.is_available():
        free, total = torch.cuda.mem_get_info()
        cuda = total - free - torch.cuda.memory_reserved()  # and other processes: there should be none
        torch.cuda.set_per_process_memory_fraction(min((1e9 * gigabytes - cuda) / total, 1.0))
        torch.cuda.reset_peak_memory_stats()


if __name__ == "__main__":
    tyro.cli(Fits).main()
