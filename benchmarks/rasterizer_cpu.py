# SPDX-License-Identifier: Apache-2.0
"""Time the CPU rasterizer, forward and backward, beside a plain autograd tile loop in the same run.

    python benchmarks/rasterizer_cpu.py                                   # the four standard sizes
    python benchmarks/rasterizer_cpu.py --checkpoint path/to/step.ckpt    # and a trained nerfstudio scene
    python benchmarks/rasterizer_cpu.py --sizes 20000x256x256 --no-loop --repeats 5

The loop is what one would write first: gsplat's lists of 16-pixel tiles, then for each tile alpha, cumulative product
and sum in plain torch, differentiated by autograd. Both compute the same image, which is checked before anything is
timed. Figures are medians in milliseconds over rounds of repeats, ours and the loop in turn; projection is included.
Beside the median of the rounds' ratios stands the ratio of the fastest rounds: on a machine with other work to do,
several threads make every operation wait for the slowest of them. `load` is the number of processes that ran or
waited meanwhile, ours included. Peak memory is measured in a process of its own per size.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from nrfgs_ns.checkpoint import allow_nerfstudio_checkpoints  # noqa: E402
from nrfgs_ns.rasterizer import Projection, project, rasterization  # noqa: E402

SIZES = ["20000x256x256", "50000x400x300", "200000x800x600", "200000x1600x1200"]
LOOP_TILE = 16


@dataclass
class Scene:
    """Arguments of `rasterization` with leaves that require gradients."""

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


def trained(path: Path, width: int, height: int) -> Scene:
    """The splats of a nerfstudio checkpoint, base colours only, seen from outside along the mean viewing axis of its
    cloud.
    """
    allow_nerfstudio_checkpoints()
    state = torch.load(path, map_location="cpu", weights_only=True)["pipeline"]
    splats = {key.rsplit(".", 1)[-1]: t.float() for key, t in state.items() if ".gauss_params." in key}
    base = splats.get("features_dc", splats.get("colors"))
    if base is None:
        raise KeyError(f"{path} holds no base colours: found {sorted(splats)}")
    means = splats["means"]
    centre, spread = means.median(0).values, (means - means.median(0).values).norm(dim=-1).median()
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # nerfstudio's z is up; look along +y
    viewmat[:3, 3] = -viewmat[:3, :3] @ (centre - torch.tensor([0.0, 1.0, 0.0]) * 1.5 * spread)
    focal = 0.8 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    tensors = [means, splats["quats"], splats["scales"].exp(), splats["opacities"].squeeze(-1).sigmoid(), base]
    leaves = [t.detach().clone().requires_grad_() for t in tensors]
    return Scene([*leaves, viewmat[None], K[None]], width, height)


def plain_loop(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    w: int,
    h: int,
) -> tuple[Tensor, Tensor]:
    """The baseline: one camera, 16-pixel tiles one after the other, gradients by autograd."""
    p: Projection = project(means, quats, scales, viewmats, Ks, w, h)
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


def timed(render, scene: Scene, repeats: int) -> dict[str, float]:
    """Median milliseconds of forward and backward after one unmeasured run."""
    forward, backward = [], []
    for i in range(repeats + 1):
        for t in scene.tensors:
            t.grad = None
        start = time.perf_counter()
        image, alphas = render(*scene.arguments)[:2]
        middle = time.perf_counter()
        (image.sum() + alphas.sum()).backward()
        end = time.perf_counter()
        if i > 0 or repeats == 0:
            forward.append(1e3 * (middle - start))
            backward.append(1e3 * (end - middle))
    return {"forward_ms": statistics.median(forward), "backward_ms": statistics.median(backward)}


def agree(scene: Scene) -> float:
    """Mean absolute difference of the two images: 1e-6 or so; a few pixels may fall on the other side of a cut-off."""
    with torch.no_grad():
        return float((rasterization(*scene.arguments)[0] - plain_loop(*scene.arguments)[0]).abs().mean())


def peak_memory(n: int, width: int, height: int) -> float:
    """MiB by which the peak of one forward and backward exceeds what the process held before. Linux only."""
    scene = cloud(n, width, height)
    # A first small image loads libraries and starts threads.
    timed(rasterization, cloud(100, 32, 32), 0)
    before = memory_kib("VmRSS")
    timed(rasterization, scene, 0)
    return (memory_kib("VmHWM") - before) / 1024


def memory_kib(field: str) -> int:
    """A line of Linux's account of this process: VmRSS is what it holds now, VmHWM the most it ever held."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="splats x width x height")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--checkpoint", type=Path, help="a nerfstudio checkpoint, timed at 800 x 600")
    parser.add_argument("--no-loop", action="store_true", help="skip the baseline")
    parser.add_argument("--out", type=Path, default=Path("docs/results/rasterizer_cpu.json"))
    parser.add_argument("--peak-memory", metavar="SIZE", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.peak_memory:
        print(peak_memory(*map(int, arguments.peak_memory.split("x"))))
        return

    scenes = {}
    for size in arguments.sizes:
        scenes[size] = cloud(*map(int, size.split("x")))
    if "50000x400x300" in scenes:
        scenes["50000x400x300 opaque"] = cloud(50000, 400, 300, opaque=True)
    if arguments.checkpoint:
        scenes[f"{arguments.checkpoint.stem} 800x600"] = trained(arguments.checkpoint, 800, 600)

    rows = {}
    for name, scene in scenes.items():
        row: dict = {"ours": timed(rasterization, scene, arguments.repeats)}
        line = f"{name:24} ours {row['ours']['forward_ms']:6.0f} + {row['ours']['backward_ms']:6.0f} ms"
        if not arguments.no_loop:
            row["mean_difference"] = agree(scene)
            if row["mean_difference"] > 1e-4:
                sys.exit(f"{name}: the two images differ by {row['mean_difference']:.1e} on average")
            # In turns, so that a machine that slows down for a while slows both.
            rounds = [(row["ours"], timed(plain_loop, scene, 1))]
            for _ in range(arguments.rounds - 1):
                rounds.append((timed(rasterization, scene, arguments.repeats), timed(plain_loop, scene, 1)))
            row["rounds"] = [{"ours": ours, "loop": loop} for ours, loop in rounds]
            ratios = [sum(loop.values()) / sum(ours.values()) for ours, loop in rounds]
            row["times_faster"] = statistics.median(ratios)
            fastest = [min(sum(turn.values()) for turn in turns) for turns in zip(*rounds, strict=True)]
            row["times_faster_fastest"] = fastest[1] / fastest[0]
            for which, values in zip(("ours", "loop"), zip(*rounds, strict=True), strict=True):
                row[which] = {key: statistics.median(value[key] for value in values) for key in values[0]}
            line = f"{name:24} ours {row['ours']['forward_ms']:6.0f} + {row['ours']['backward_ms']:6.0f} ms"
            line += f"   loop {row['loop']['forward_ms']:6.0f} + {row['loop']['backward_ms']:6.0f} ms"
            line += f"   {row['times_faster']:5.1f} ({min(ratios):.1f}-{max(ratios):.1f}) times faster"
            line += f", fastest rounds {row['times_faster_fastest']:.1f}"
        row["load"] = round(os.getloadavg()[0], 1)
        if name in arguments.sizes:
            command = [sys.executable, __file__, "--peak-memory", name, "--threads", str(arguments.threads)]
            row["peak_memory_mib"] = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            line += f"   peak {row['peak_memory_mib']:4.0f} MiB"
        print(line, flush=True)
        rows[name] = row

    machine = {
        "name": f"{os.cpu_count()} CPU cores",
        "threads": arguments.threads,
        "torch": torch.__version__,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(
        json.dumps({"machine": machine, "repeats": arguments.repeats, "results": rows}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
