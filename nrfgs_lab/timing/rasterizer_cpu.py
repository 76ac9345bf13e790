# SPDX-License-Identifier: Apache-2.0
"""Time the CPU rasterizer, forward and backward, beside a plain autograd tile loop in the same run.

    python -m nrfgs_lab.timing.rasterizer_cpu --out rasterizer_cpu.json      # the standard cases, two threads

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
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # before torch looks for GPUs: this is about the CPU

import torch  # noqa: E402
import tyro  # noqa: E402
from torch import Tensor  # noqa: E402

from nrfgs_ns.files import write_whole  # noqa: E402
from nrfgs_ns.rasterizer import composite, project  # noqa: E402

SIZES = "20000x256x256", "50000x400x300", "50000x400x300 opaque", "200000x800x600", "200000x1600x1200"
"""Splats x width x height; "opaque": every opacity is 0.95, which is what early termination is for."""
LOOP_TILE = 16
ROUNDS = 5
OURS_IN_A_ROUND = 3


def cloud(size: str) -> list:
    """Arguments of `ours`, the first five with gradients: a random cloud that fills the image.

    Standard deviations are log-normal around 2 pixels, opacities uniform in [0, 1].
    """
    size, *opaque = size.split()
    n, width, height = map(int, size.split("x"))
    g = torch.Generator().manual_seed(0)
    focal = 0.8 * width
    depth = 2 + 6 * torch.rand(n, 1, generator=g)
    pixel = torch.rand(n, 2, generator=g) * torch.tensor([width, height])
    means = torch.cat([(pixel - torch.tensor([width / 2, height / 2])) / focal * depth, depth], 1)
    scales = 2.0 / focal * depth * torch.exp(0.5 * torch.randn(n, 3, generator=g))
    opacities = torch.full((n,), 0.95) if opaque else torch.rand(n, generator=g)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    leaves = [means, torch.randn(n, 4, generator=g), scales, opacities, torch.rand(n, 3, generator=g)]
    return [*(leaf.requires_grad_() for leaf in leaves), torch.eye(4)[None], K[None], width, height]


def ours(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, *camera) -> tuple:
    """The rasterizer of trainings."""
    p = project(means, quats, scales, *camera)
    return composite(p, colors[p.gaussian_ids], opacities[p.gaussian_ids])[:2]


def plain_loop(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, *camera
) -> tuple[Tensor, Tensor]:
    """The baseline: one camera, 16-pixel tiles one after the other, gradients by autograd."""
    p = project(means, quats, scales, *camera)
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
    image = torch.cat(bands)[None]
    return image[..., :-1], image[..., -1:]


def timed(render, scene: list) -> tuple[float, float]:
    """Milliseconds of forward and backward."""
    for leaf in scene[:5]:
        leaf.grad = None
    start = time.perf_counter()
    image, alphas = render(*scene)
    middle = time.perf_counter()
    (image.sum() + alphas.sum()).backward()
    return 1e3 * (middle - start), 1e3 * (time.perf_counter() - middle)


def measure(name: str) -> dict:
    """Record of one size."""
    scene = cloud(name)
    with torch.no_grad():
        difference = float((ours(*scene)[0] - plain_loop(*scene)[0]).abs().mean())
    if difference > 1e-4:  # a few pixels may fall on the other side of a cut-off
        sys.exit(f"{name}: the two images differ by {difference:.1e} on average")
    times: dict[str, list[tuple[float, float]]] = {"ours": [], "loop": []}
    timed(ours, scene)
    for _ in range(ROUNDS):  # in turns: a machine that slows down for a while slows both
        times["ours"] += [timed(ours, scene) for _ in range(OURS_IN_A_ROUND)]
        times["loop"].append(timed(plain_loop, scene))
    medians = {which: [statistics.median(part) for part in zip(*pairs, strict=True)] for which, pairs in times.items()}
    command = [sys.executable, "-m", "nrfgs_lab.timing.rasterizer_cpu", "--peak-memory", name]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return {
        "mean_difference": difference,
        **{which: {"forward_ms": forward, "backward_ms": back} for which, (forward, back) in medians.items()},
        "times_faster": sum(medians["loop"]) / sum(medians["ours"]),
        "peak_memory_mib": float(output),
    }


def memory_kib(field: str) -> int:
    """A line of /proc/self/status: VmRSS is the memory now, VmHWM its peak. Linux only."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field))


def main(out: Path = Path("rasterizer_cpu.json"), threads: int = 2, peak_memory: str | None = None) -> None:
    """Time of the CPU rasterizer and of a plain loop.

    Args:
        out: JSON file of the results.
        threads: of torch.
        peak_memory: print the MiB by which one size's forward and backward raise the process's peak, and no more.
    """
    torch.set_num_threads(threads)
    if peak_memory:
        timed(ours, cloud("100x32x32"))  # loads libraries and starts threads
        scene, before = cloud(peak_memory), memory_kib("VmRSS")
        timed(ours, scene)
        print((memory_kib("VmHWM") - before) / 1024)
        return
    results: dict[str, dict] = {}
    for name in SIZES:
        results[name] = measure(name)
        print(name, results[name], flush=True)
        machine = {"name": f"{os.cpu_count()} CPU cores", "torch": torch.__version__}
        write_whole(out, json.dumps({"machine": machine, "threads": threads, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
