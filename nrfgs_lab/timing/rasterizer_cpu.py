# SPDX-License-Identifier: Apache-2.0
"""Time the CPU rasterizer, forward and backward, beside a plain autograd tile loop in the same run.

    python -m nrfgs_lab.timing.rasterizer_cpu --out rasterizer_cpu.json      # the standard cases, two threads
    python -m nrfgs_lab.timing.rasterizer_cpu --sizes 20000x256x256 --no-loop --out small.json

The loop is the simplest correct rasterizer: gsplat's lists of 16-pixel tiles, and in each tile alpha, cumulative
product and sum in plain torch, differentiated by autograd. That both render the same image is checked first. Times are
medians in milliseconds over rounds, ours and the loop in turn, with projection. Peak memory is of a separate process.
"""

import json
import math
import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # before torch looks for GPUs: this is about the CPU

import torch  # noqa: E402
import tyro  # noqa: E402
from torch import Tensor  # noqa: E402

from nrfgs_ns.files import write_whole  # noqa: E402
from nrfgs_ns.rasterizer import Projection, composite, project  # noqa: E402

SIZES = "20000x256x256", "50000x400x300", "50000x400x300 opaque", "200000x800x600", "200000x1600x1200"
LOOP_TILE = 16


@dataclass
class Scene:
    """Arguments of `ours` with leaves that require gradients."""

    tensors: list[Tensor]
    width: int
    height: int

    @property
    def arguments(self) -> tuple:
        return *self.tensors, self.width, self.height


def cloud(n: int, width: int, height: int, opaque: bool = False) -> Scene:
    """A random cloud that fills the image: standard deviations log-normal around 2 pixels, opacities uniform in [0, 1].

    `opaque` gives every splat an opacity of 0.95: what early termination is for.
    """
    g = torch.Generator().manual_seed(0)
    focal = 0.8 * width
    depth = 2 + 6 * torch.rand(n, 1, generator=g)
    pixel = torch.rand(n, 2, generator=g) * torch.tensor([width, height])
    means = torch.cat([(pixel - torch.tensor([width / 2, height / 2])) / focal * depth, depth], 1)
    scales = 2.0 / focal * depth * torch.exp(0.5 * torch.randn(n, 3, generator=g))
    opacities = torch.full((n,), 0.95) if opaque else torch.rand(n, generator=g)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    tensors = [means, torch.randn(n, 4, generator=g), scales, opacities, torch.rand(n, 3, generator=g)]
    return Scene([t.requires_grad_() for t in tensors] + [torch.eye(4)[None], K[None]], width, height)


def cloud_of(size: str) -> Scene:
    """Cloud of a size of `RasterizerCpu`."""
    size, *opaque = size.split()
    return cloud(*map(int, size.split("x")), opaque=bool(opaque))


def ours(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, *camera) -> tuple:
    """The rasterizer of trainings."""
    p = project(means, quats, scales, *camera)
    return composite(p, colors[p.gaussian_ids], opacities[p.gaussian_ids])[:2]


def plain_loop(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, *camera
) -> tuple[Tensor, Tensor]:
    """The baseline: one camera, 16-pixel tiles one after the other, gradients by autograd."""
    p: Projection = project(means, quats, scales, *camera)
    w, h = camera[-2:]
    colors, opacities = colors[p.gaussian_ids], opacities[p.gaussian_ids]
    with torch.no_grad():
        nearest_first = p.depths.sort(stable=True).indices
        low = ((p.means2d - p.radii[:, None]) / LOOP_TILE).floor()[nearest_first]
        high = ((p.means2d + p.radii[:, None]) / LOOP_TILE).ceil()[nearest_first]
    bands = []
    for ty in range(math.ceil(h / LOOP_TILE)):
        row = nearest_first[(low[:, 1] <= ty) & (ty < high[:, 1])]
        row_low, row_high = (b[(low[:, 1] <= ty) & (ty < high[:, 1]), 0] for b in (low, high))
        y = torch.arange(ty * LOOP_TILE, min(h, (ty + 1) * LOOP_TILE)) + 0.5
        band = []
        for tx in range(math.ceil(w / LOOP_TILE)):
            ids = row[(row_low <= tx) & (tx < row_high)]
            x = torch.arange(tx * LOOP_TILE, min(w, (tx + 1) * LOOP_TILE)) + 0.5
            dx = x[None, None, :] - p.means2d[ids, 0, None, None]
            dy = y[None, :, None] - p.means2d[ids, 1, None, None]
            a, b, c = (q[:, None, None] for q in p.conics[ids].unbind(-1))
            alpha = opacities[ids, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = torch.where(alpha >= 1 / 255, alpha.clamp(max=0.999), 0.0)
            after = torch.cumprod(1 - alpha, 0)
            before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
            weights = torch.where(after > 1e-4, alpha * before, 0.0)
            rendered = torch.einsum("nyx,nd->yxd", weights, colors[ids])
            band.append(torch.cat([rendered, weights.sum(0)[..., None]], -1))
        bands.append(torch.cat(band, 1))
    image = torch.cat(bands)
    image, alphas = image[..., :-1], image[..., -1:]
    return image[None], alphas[None]


def timed(render, scene: Scene, repeats: int, warm: bool = True) -> dict[str, float]:
    """Median milliseconds of forward and backward, after one unmeasured run where `warm`."""
    forward, backward = [], []
    for i in range(repeats + warm):
        for t in scene.tensors:
            t.grad = None
        start = time.perf_counter()
        image, alphas = render(*scene.arguments)[:2]
        middle = time.perf_counter()
        (image.sum() + alphas.sum()).backward()
        end = time.perf_counter()
        if i >= warm:
            forward.append(1e3 * (middle - start))
            backward.append(1e3 * (end - middle))
    return {"forward_ms": statistics.median(forward), "backward_ms": statistics.median(backward)}


def agree(scene: Scene) -> float:
    """Mean absolute difference of the two images: 1e-6 or so; a few pixels may fall on the other side of a cut-off."""
    with torch.no_grad():
        return float((ours(*scene.arguments)[0] - plain_loop(*scene.arguments)[0]).abs().mean())


def peak_memory(scene: Scene) -> float:
    """MiB by which one forward and backward raises the process's peak memory. Linux only."""
    # A first small image loads libraries and starts threads.
    timed(ours, cloud(100, 32, 32), 1, warm=False)
    before = memory_kib("VmRSS")
    timed(ours, scene, 1, warm=False)
    return (memory_kib("VmHWM") - before) / 1024


def memory_kib(field: str) -> int:
    """A line of /proc/self/status: VmRSS is the memory now, VmHWM its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field))


@dataclass
class RasterizerCpu:
    """Time of the CPU rasterizer and of a plain loop."""

    sizes: tuple[str, ...] = SIZES
    """splats x width x height, perhaps followed by "opaque\""""
    repeats: int = 3
    """runs of ours in a round"""
    rounds: int = 5
    threads: int = 2
    loop: bool = True
    """time the loop, too"""
    out: Path = Path("rasterizer_cpu.json")
    """JSON file of the results"""
    peak_memory: str | None = None
    """print the peak memory of one size, MiB, and do nothing else"""

    def main(self) -> None:
        torch.set_num_threads(self.threads)
        if self.peak_memory:
            print(peak_memory(cloud_of(self.peak_memory)))
            return
        machine = {"name": f"{os.cpu_count()} CPU cores", "torch": torch.__version__}
        results = {}
        for name in self.sizes:
            results[name] = self.measure(name)
            record = {"machine": machine, "threads": self.threads, "repeats": self.repeats, "results": results}
            write_whole(self.out, json.dumps(record, indent=1) + "\n")

    def measure(self, name: str) -> dict:
        """Measure one size, and print its record."""
        scene = cloud_of(name)
        row: dict = {"splats": len(scene.tensors[0]), "image": [scene.width, scene.height]}
        if self.loop:
            row["mean_difference"] = agree(scene)  # also the loop's unmeasured run
            if row["mean_difference"] > 1e-4:
                sys.exit(f"{name}: the two images differ by {row['mean_difference']:.1e} on average")
        rounds: list[dict[str, dict[str, float]]] = []
        for _ in range(self.rounds):  # in turns: a machine that slows down for a while slows both
            rounds.append({"ours": timed(ours, scene, self.repeats)})
            if self.loop:
                rounds[-1]["loop"] = timed(plain_loop, scene, 1, warm=False)
        for which in rounds[0]:
            row[which] = {key: statistics.median(r[which][key] for r in rounds) for key in rounds[0][which]}
        if self.loop:
            row["times_faster"] = statistics.median(sum(r["loop"].values()) / sum(r["ours"].values()) for r in rounds)
        command = [sys.executable, "-m", "nrfgs_lab.timing.rasterizer_cpu", "--threads", str(self.threads)]
        output = subprocess.run([*command, "--peak-memory", name], check=True, stdout=subprocess.PIPE, text=True).stdout
        row |= {"rounds": rounds, "load": round(os.getloadavg()[0], 1), "peak_memory_mib": float(output)}
        print(name, {key: value for key, value in row.items() if key != "rounds"}, flush=True)
        return row


if __name__ == "__main__":
    tyro.cli(RasterizerCpu).main()
