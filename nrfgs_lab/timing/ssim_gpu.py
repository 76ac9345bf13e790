# SPDX-License-Identifier: Apache-2.0
"""Time splatfacto's loss, (1 - lambda) L1 + lambda (1 - SSIM), on a CUDA device: nerfstudio's way beside the fused one.

    python -m nrfgs_lab.timing.ssim_gpu --out ssim_gpu.json
    python -m nrfgs_lab.timing.ssim_gpu --rows 8 16 24 32     # rows of a program, a launch constant
    python -m nrfgs_lab.timing.ssim_gpu --device cpu --sizes 200x150 800x600 --out ssim_cpu.json

A call is the loss and its gradient by the image. Variants take turns within a round; a round is `repeats` calls between
two CUDA events, and the host's time to issue them is taken beside it: where it is the larger one, the step is bound by
the host. Reported are medians over rounds and the least round. On a CPU, events and host are the same clock.
"""

import contextlib
import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from pytorch_msssim import SSIM
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from nrfgs_ns.image.ssim import photometric_loss, ssim  # noqa: E402
from nrfgs_ns.training.run import machine  # noqa: E402

LAMBDA = 0.2


@dataclass
class SsimBenchmark:
    """What to time, and where results go."""

    out: Path | None = None
    """JSON file for the results"""
    sizes: tuple[str, ...] = ("400x266", "799x532", "1297x840", "1600x1200")
    """images, WIDTHxHEIGHT"""
    rounds: int = 15
    """rounds in which the variants take turns"""
    repeats: int = 20
    """calls in a round"""
    rows: tuple[int, ...] = ()
    """time the kernels with these rows a program too"""
    device: str = "cuda"
    """cuda or cpu"""

    def main(self) -> None:
        results = []
        for size in track(self.sizes, console=Console(stderr=True)):
            width, height = (int(side) for side in size.split("x"))
            results += self.measure(width, height)
        self.show(results)
        if self.out is not None:
            content = {"machine": machine(), "rounds": self.rounds, "repeats": self.repeats, "times": results}
            self.out.parent.mkdir(parents=True, exist_ok=True)
            self.out.write_text(json.dumps(content, indent=1) + "\n")

    def measure(self, width: int, height: int) -> list[dict[str, Any]]:
        """A row for each variant at one size."""
        torch.manual_seed(0)
        truth = torch.rand(height, width, 3, device=self.device)
        prediction = (truth + 0.1 * torch.randn_like(truth)).clamp(0.0, 1.0).requires_grad_()
        samples = {name: ([], []) for name in self.variants()}
        for turn in range(self.rounds + 1):
            for name, loss in self.variants().items():
                with rows_of_a_program(name):
                    spent = self.timed(loss, prediction, truth)
                if turn > 0:  # the first one compiles
                    for kept, seconds in zip(samples[name], spent, strict=True):
                        kept.append(seconds)
        return [
            {
                "width": width,
                "height": height,
                "variant": name,
                "ms": statistics.median(device),
                "least_ms": min(device),
                "host_ms": statistics.median(host),
            }
            for name, (device, host) in samples.items()
        ]

    def variants(self) -> dict[str, Callable[[Tensor, Tensor], Tensor]]:
        """Losses by name."""
        library = SSIM(data_range=1.0, size_average=True, channel=3)

        def library_ssim(prediction: Tensor, truth: Tensor) -> Tensor:
            return library(truth.permute(2, 0, 1)[None], prediction.permute(2, 0, 1)[None])

        def library_loss(prediction: Tensor, truth: Tensor) -> Tensor:
            l1 = torch.abs(truth - prediction).mean()
            return (1 - LAMBDA) * l1 + LAMBDA * (1 - library_ssim(prediction, truth))

        def fused_loss(prediction: Tensor, truth: Tensor) -> Tensor:
            return photometric_loss(prediction, truth, LAMBDA)

        chosen = {
            "pytorch_msssim, SSIM": library_ssim,
            "fused, SSIM": ssim,
            "pytorch_msssim, loss": library_loss,
            "fused, loss": fused_loss,
        }
        return chosen | {f"fused, loss, {rows} rows": fused_loss for rows in self.rows}

    def timed(self, loss: Callable[[Tensor, Tensor], Tensor], prediction: Tensor, truth: Tensor) -> tuple[float, float]:
        """Milliseconds of a call: on the device, and until the host has issued it."""
        on_gpu = self.device == "cuda"
        if on_gpu:
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            begin.record()
        start = time.perf_counter()
        for _ in range(self.repeats):
            prediction.grad = None
            loss(prediction, truth).backward()
        host = 1e3 * (time.perf_counter() - start) / self.repeats
        if not on_gpu:
            return host, host
        end.record()
        torch.cuda.synchronize()
        return begin.elapsed_time(end) / self.repeats, host

    def show(self, results: list[dict[str, Any]]) -> None:
        """Print the results."""
        table = Table("size", "variant", "ms", "least ms", "host ms")
        for row in results:
            times = [f"{row[name]:.3f}" for name in ("ms", "least_ms", "host_ms")]
            table.add_row(f"{row['width']}x{row['height']}", row["variant"], *times)
        Console(width=100).print(table)


@contextlib.contextmanager
def rows_of_a_program(variant: str) -> Iterator[None]:
    """Change the kernels' launch constant while a variant "..., N rows" is timed."""
    if not variant.endswith(" rows"):
        yield
        return
    from nrfgs_ns.image import ssim_triton

    usual = ssim_triton.ROWS
    ssim_triton.ROWS = int(variant.split()[-2])
    try:
        yield
    finally:
        ssim_triton.ROWS = usual


if __name__ == "__main__":
    tyro.cli(SsimBenchmark).main()
