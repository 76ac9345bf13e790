# SPDX-License-Identifier: Apache-2.0
"""Time the appearance head alone on a CUDA device: the fused field beside PyTorch's and beside the other heads.

    python -m nrfgs_lab.timing.head_gpu --out head_gpu.json
    python -m nrfgs_lab.timing.head_gpu --sizes --out head_gpu_diffuse.json   # diffuse splats alone
    TRITON_INTERPRET=1 python -m nrfgs_lab.timing.head_gpu --device cpu --sizes 200 --diffuse-sizes 200 --rounds 1

A table of N splats of which M are visible, from one camera; M = N ("all"), and M = N / 2 picked at random ("half").
Times are medians over rounds in which the variants take turns; a round is `repeats` calls between two CUDA events.
A call is the head's forward, or forward and backward of a random weighting of colours and opacities with gradients to
every table and weight. Peak memory is what one such call adds. Errors are norms relative to PyTorch's float64 head on
100,000 splats. A variant that fails is listed with its error. The last line above tries the script.

With diffuse splats, half of the table is visible, and they are its last rows, as in a training. "mask": the kernels are
told which they are. "others only": kernels that know no mask compute the others, which PyTorch picks, and whose answers
it puts among the base appearances of all. "no mask": all have their residual.
"""

import itertools
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from nrfgs_ns.appearance.diffuse import DIFFUSE, Others
from nrfgs_ns.appearance.gsnb import GsnbConfig
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.sg import SgConfig
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.appearance.vdgs import VdgsConfig

PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
ERROR_SPLATS = 100_000


@dataclass
class Variant:
    """Something to time: a function of tables, visible rows and camera centre, and the leaves of its gradient."""

    run: Callable[[], tuple[Tensor, ...]]
    leaves: list[Tensor]
    weights: tuple[Tensor, ...] = ()
    waits: bool = False
    """whether it waits for the device, so that it cannot be captured"""

    def forward(self) -> None:
        with torch.no_grad():
            self.run()

    def forward_backward(self) -> None:
        for leaf in self.leaves:
            leaf.grad = None
        outputs = self.run()
        if not self.weights:
            self.weights = tuple(torch.randn_like(output) for output in outputs)
        torch.autograd.backward(outputs, self.weights)


@dataclass
class HeadBenchmark:
    """What to time, and where results go."""

    out: Path | None = None
    """JSON file for the results"""
    sizes: tuple[int, ...] = (100_000, 300_000, 1_000_000, 3_000_000)
    """visible splats M"""
    diffuse_sizes: tuple[int, ...] = (300_000, 1_000_000)
    """visible splats M, some of them diffuse"""
    diffuse_shares: tuple[float, ...] = (0.0, 0.5, 0.8, 0.95)
    """of the splats: how many are diffuse"""
    rounds: int = 7
    """rounds in which the variants take turns"""
    repeats: int = 20
    """calls in a round"""
    device: str = "cuda"
    """cuda; cpu only tries the script"""
    compile: bool = True
    """time torch.compile of PyTorch's head too; compiling takes a minute"""

    def main(self) -> None:
        results: dict[str, list[dict]] = {"errors": self.errors() if self.sizes else [], "times": [], "diffuse": []}
        for visible, share in itertools.product(self.sizes, ("all", "half")):
            results["times"] += self.times(visible, share)
            self.save(results)  # what is cut short keeps what it has
        for visible, share in itertools.product(self.diffuse_sizes, self.diffuse_shares):
            results["diffuse"] += self.diffuse_times(visible, share)
            self.save(results)
        self.show(results["times"] + results["diffuse"])

    def save(self, results: dict[str, list[dict]]) -> None:
        if self.out is not None:
            results = {"machine": self.machine(), "rounds": self.rounds, "repeats": self.repeats, **results}
            self.out.parent.mkdir(parents=True, exist_ok=True)
            self.out.write_text(json.dumps(results, indent=2) + "\n")

    def machine(self) -> dict[str, str]:
        found = {"torch": torch.__version__}
        try:
            import triton

            found["triton"] = triton.__version__
        except ImportError as error:
            found["triton"] = str(error)
        found["device"] = torch.cuda.get_device_name() if self.device == "cuda" else self.device
        return found

    # What is timed.

    def scene(self, count: int, visible: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Tables of `count` splats with latents and harmonics, visible rows, and a camera centre."""
        torch.manual_seed(0)
        options = {"device": self.device}
        splats = {
            "means": 2 * torch.rand(count, 3, **options) - 1,
            "opacities": torch.randn(count, 1, **options),
            "features_dc": torch.randn(count, 3, **options),
            "latents": torch.randn(count, 32, **options),
            "features_rest": torch.randn(count, 15, 3, **options),
        }
        rows = torch.arange(count, **options)
        if visible < count:
            rows = torch.randperm(count, **options)[:visible].sort().values  # projection lists rows in order
        leaves = {name: value.requires_grad_() for name, value in splats.items()}
        return leaves, rows, torch.tensor([0.0, 0.0, 3.0], **options)

    def field(self, **config):
        torch.manual_seed(1)
        return NrfConfig(output_init="default", **config).setup().to(self.device)

    def variant(self, head, splats: dict[str, Tensor], rows: Tensor, center: Tensor, names: tuple[str, ...]) -> Variant:
        tables = {name: splats[name] for name in names}
        return Variant(lambda: tuple(head(tables, rows, center)), [*tables.values(), *head.parameters()])

    def peer(
        self, config, splats: dict[str, Tensor], rows: Tensor, center: Tensor, plain_grid: bool = False
    ) -> Variant:
        """Another head, with what it stores for each splat beside means and opacities; VDGS's hash grid in PyTorch, if
        `plain_grid`."""
        torch.manual_seed(1)
        head = config.setup().to(self.device)
        head.set_step(10**6)  # all of its degrees and lobes
        if plain_grid:
            head.grid.forward = head.grid.in_torch
        own = head.splat_params(torch.rand(len(splats["means"]), 3, device=self.device))
        tables = {name: splats.get(name, value.requires_grad_()) for name, value in own.items()}
        tables |= {name: splats[name] for name in ("means", "opacities")}
        return self.variant(head, tables, rows, center, tuple(tables))

    def variants(self, splats: dict[str, Tensor], rows: Tensor, center: Tensor) -> dict[str, Callable[[], Variant]]:
        """What to time, by name; each is built when its turn comes, so that one that fails stops nothing."""
        nrf = ("means", "opacities", "features_dc", "latents")

        def peer(config, **how):
            return lambda: self.peer(config, splats, rows, center, **how)

        def fused(precision):
            return self.variant(self.field(implementation="fused", precision=precision), splats, rows, center, nrf)

        def compiled():
            head = self.field(implementation="torch")
            run = torch.compile(head.forward, dynamic=True)
            tables = {name: splats[name] for name in nrf}
            return Variant(lambda: tuple(run(tables, rows, center)), [*tables.values(), *head.parameters()])

        def harmonics_kernel():
            from nrfgs_ns.appearance.spherical_harmonics import eval_sh

            directions = (splats["means"].detach()[rows] - center).requires_grad_()
            coefficients = torch.randn(len(rows), 16, 3, device=self.device).requires_grad_()
            return Variant(lambda: (eval_sh(3, directions, coefficients),), [directions, coefficients])

        chosen = {f"fused {p}": lambda p=p: fused(p) for p in PRECISIONS}
        chosen["torch"] = lambda: self.variant(self.field(implementation="torch"), splats, rows, center, nrf)
        if self.compile:
            chosen["torch.compile"] = compiled
        chosen["sh head"] = peer(ShConfig())
        chosen["sh kernel"] = harmonics_kernel
        chosen["vdgs head"] = peer(VdgsConfig())
        chosen["vdgs head, grid in PyTorch"] = peer(VdgsConfig(), plain_grid=True)
        chosen["gsnb head"] = peer(GsnbConfig())
        chosen["sg head"] = peer(SgConfig())
        return chosen

    def diffuse_variants(
        self, splats: dict[str, Tensor], rows: Tensor, center: Tensor, share: float
    ) -> dict[str, Callable[[], Variant]]:
        """The default head where the last `share` of the splats are diffuse."""
        tables = {name: splats[name] for name in ("means", "opacities", "features_dc", "latents")}
        count = len(splats["means"])
        mask = torch.arange(count, device=self.device) >= round((1.0 - share) * count)

        def variant(run: Callable, waits: bool = False) -> Variant:
            head = self.field(implementation="fused")
            return Variant(lambda: tuple(run(head)), [*tables.values(), *head.parameters()], waits=waits)

        def others_only(head):
            others = Others({**tables, DIFFUSE: mask}, rows, center)
            return others.over(head.base_appearance(tables, rows), head(*others.arguments))

        return {
            "no mask": lambda: variant(lambda head: head(tables, rows, center)),
            "mask": lambda: variant(lambda head: head({**tables, DIFFUSE: mask}, rows, center)),
            "others only": lambda: variant(others_only, waits=True),
        }

    # Timing.

    def times(self, visible: int, share: str) -> list[dict]:
        count = visible if share == "all" else 2 * visible
        labels = {"visible": visible, "share": share}
        return self.take_turns(self.variants(*self.scene(count, visible)), labels)

    def diffuse_times(self, visible: int, share: float) -> list[dict]:
        labels = {"visible": visible, "share": "half", "diffuse": share}
        return self.take_turns(self.diffuse_variants(*self.scene(2 * visible, visible), share), labels)

    def take_turns(self, builders: dict[str, Callable[[], Variant]], labels: dict) -> list[dict]:
        """A row of medians for each variant: "forward_ms", "both_ms" and their spread, "gpu_ms", or "error".

        The first three are taken as a training calls them: small sizes wait for the host. "gpu_ms" replays forward and
        backward as one CUDA graph, which the host only starts; null where a variant cannot be captured.
        """
        built: dict[str, Variant] = {}
        rows = {name: {**labels, "variant": name} for name in builders}
        for name, build in builders.items():
            try:
                built[name] = build()
                for _ in range(3):  # compile, and let allocations settle
                    built[name].forward()
                    built[name].forward_backward()
                self.synchronize()
                if self.device == "cuda":
                    rows[name]["peak_mib"] = self.peak_memory(built[name])
            except Exception as error:  # one variant that cannot run must not lose the others
                built.pop(name, None)
                rows[name]["error"] = f"{type(error).__name__}: {error}"[:500]
        samples = {name: ([], []) for name in built}
        for _ in track(range(self.rounds), description=str(labels), console=Console(stderr=True)):
            for name, variant in built.items():
                samples[name][0].append(self.milliseconds(variant.forward))
                samples[name][1].append(self.milliseconds(variant.forward_backward))
        for name, (forward, both) in samples.items():
            rows[name] |= {"forward_ms": statistics.median(forward), "both_ms": statistics.median(both)}
            rows[name]["both_range_ms"] = [min(both), max(both)]
            rows[name]["gpu_ms"] = self.replayed(built[name]) if self.device == "cuda" else None
        return list(rows.values())

    def replayed(self, variant: Variant) -> float | None:
        """Median milliseconds of forward and backward without the host, or None."""
        if variant.waits:
            return None
        for leaf in variant.leaves:
            leaf.grad = None
        try:
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):  # as CUDA graphs want it: warmed up off the default stream
                variant.forward_backward()
            torch.cuda.current_stream().wait_stream(side)
            for leaf in variant.leaves:
                leaf.grad = None
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                variant.forward_backward()
        except Exception as error:
            print(f"not captured: {type(error).__name__}: {error}"[:300], file=sys.stderr)
            self.synchronize()
            return None
        return statistics.median(self.milliseconds(graph.replay) for _ in range(self.rounds))

    def milliseconds(self, call: Callable[[], None]) -> float:
        """Mean time of a call among `repeats`."""
        if self.device != "cuda":
            start = time.perf_counter()
            for _ in range(self.repeats):
                call()
            return 1e3 * (time.perf_counter() - start) / self.repeats
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        for _ in range(self.repeats):
            call()
        end.record()
        end.synchronize()
        return begin.elapsed_time(end) / self.repeats

    def peak_memory(self, variant: Variant) -> float:
        """MiB that a forward and backward adds to what is held before, gradients included."""
        for leaf in variant.leaves:
            leaf.grad = None
        self.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        variant.forward_backward()
        self.synchronize()
        return (torch.cuda.max_memory_allocated() - before) / 2**20

    def synchronize(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()

    # Errors.

    def errors(self) -> list[dict]:
        """Relative errors of values and gradients of each precision, and of PyTorch's float32."""
        splats, rows, center = self.scene(min(ERROR_SPLATS, max(self.sizes)), min(ERROR_SPLATS, max(self.sizes)))
        splats.pop("features_rest")
        exact = self.evaluate(self.field(implementation="torch").double(), splats, rows, center, torch.float64)
        found = []
        for name, config in {
            **{f"fused {p}": {"implementation": "fused", "precision": p} for p in PRECISIONS},
            "torch": {"implementation": "torch"},
        }.items():
            row: dict = {"variant": name}
            try:
                ours = self.evaluate(self.field(**config), splats, rows, center, torch.float32)
                for key, value in exact.items():
                    row[key] = ((ours[key].double() - value).norm() / value.norm()).item()
            except Exception as error:
                row["error"] = f"{type(error).__name__}: {error}"[:500]
            found.append(row)
        table = Table("relative error of", *exact, title=f"{len(rows)} splats, against float64")
        for row in found:
            table.add_row(row["variant"], *(f"{row[key]:.1e}" if key in row else "-" for key in exact))
        Console().print(table)
        return found

    def evaluate(self, head, splats: dict[str, Tensor], rows: Tensor, center: Tensor, dtype) -> dict[str, Tensor]:
        leaves = {name: value.detach().to(dtype).requires_grad_() for name, value in splats.items()}
        colors, opacities = head(leaves, rows, center.to(dtype))
        generator = torch.Generator().manual_seed(2)
        d_colors = torch.randn(len(rows), 3, generator=generator).to(colors)
        d_opacities = torch.randn(len(rows), generator=generator).to(opacities)
        torch.autograd.backward((colors, opacities), (d_colors, d_opacities))
        gradients = {f"d {name}": leaf.grad for name, leaf in leaves.items()}
        weights = torch.cat([weight.grad.flatten() for weight in head.parameters()])
        return {"colors": colors.detach(), "opacities": opacities.detach(), **gradients, "d weights": weights}

    def show(self, rows: list[dict]) -> None:
        table = Table("variant", "visible", "of all", "forward ms", "both ms", "GPU alone ms", "peak MiB")
        for row in rows:
            numbers = [f"{row[key]:.3f}" if row.get(key) else "-" for key in ("forward_ms", "both_ms", "gpu_ms")]
            peak = f"{row['peak_mib']:.0f}" if "peak_mib" in row else "-"
            name = row["variant"] + (f", {row['diffuse']:.0%} diffuse" if "diffuse" in row else "")
            table.add_row(name, f"{row['visible']:,}", row.get("share", "all"), *numbers, peak)
        Console().print(table)
        for row in rows:
            if "error" in row:
                Console().print(f"{row['variant']}: {row['error']}", highlight=False)


if __name__ == "__main__":
    tyro.cli(HeadBenchmark).main()
