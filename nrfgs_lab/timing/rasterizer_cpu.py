# SPDX-License-Identifier: Apache-2.0
"""Time the CPU rasterizer, forward and backward, beside a plain autograd tile loop in the same run.

    python -m nrfgs_lab.timing.rasterizer_cpu                                       # the standard cases, two threads
    python -m nrfgs_lab.timing.rasterizer_cpu --scene SCENES/fox                    # and a scene that is trained first
    python -m nrfgs_lab.timing.rasterizer_cpu --config outputs/.../config.yml       # and one that has been trained
    python -m nrfgs_lab.timing.rasterizer_cpu --sizes 20000x256x256 --no-loop --repeats 5 --out small.json

The loop is what one would write first: gsplat's lists of 16-pixel tiles, then for each tile alpha, cumulative product
and sum in plain torch, differentiated by autograd. Both compute the same image, which is checked before anything is
timed. Figures are medians in milliseconds over rounds of repeats, ours and the loop in turn; projection is included.
Beside the median of the rounds' ratios stands the ratio of the fastest rounds: on a machine with other work to do,
several threads make every operation wait for the slowest of them. `load` is the number of processes that ran or
waited meanwhile, ours included. Peak memory is measured in a process of its own.

The process is bound to as many cores as threads, which share a cache where the machine tells. Two threads are slower on
cores that share none: `neighbour` tells, before and after each row, how many times longer it takes to work on numbers
of which another thread wrote half than on one's own; it is 1.0 on cores that share a cache.

The file is written after each row. Started again with the same settings, the script goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # before torch looks for GPUs: this is about the CPU

import torch  # noqa: E402
from torch import Tensor  # noqa: E402

from nrfgs_ns.rasterizer import Projection, composite, project  # noqa: E402

SIZES = ["20000x256x256", "50000x400x300", "200000x800x600", "200000x1600x1200"]
LOOP_TILE = 16
TRAINED_AT, SEEN_AT = 1 / 8, 1 / 2  # size of the images of a scene that is trained here


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
    """The cloud of a name: splats x width x height, perhaps followed by "opaque"."""
    size, *opaque = size.split()
    return cloud(*map(int, size.split("x")), opaque=bool(opaque))


def train(scene: Path | None, config: Path | None, steps: int, out: Path) -> None:
    """Save the splats of a training and one of its cameras: of a scene that is trained now, or of a saved config.yml.

    The scene is trained at an eighth of its size, with as many steps, and is seen at half its size.
    """
    from nrfgs_ns.model.pinhole import pinhole

    if config:
        from nerfstudio.utils.eval_utils import eval_setup

        from nrfgs_ns.training.checkpoint_files import allow_nerfstudio_checkpoints

        allow_nerfstudio_checkpoints()
        pipeline = eval_setup(config, test_mode="val")[1]
    else:
        pipeline = trained_pipeline(scene, steps)
    camera = pipeline.datamanager.train_dataset.cameras[0:1].to("cpu")
    target = camera.width.item() * (1 if config else SEEN_AT / TRAINED_AT)
    camera.rescale_output_resolution(target / camera.width.item())
    view = pinhole(camera, camera.camera_to_worlds, 1)
    splats = {name: tensor.detach().float() for name, tensor in pipeline.model.gauss_params.items()}
    base = splats.get("features_dc", splats.get("colors"))
    shapes = [splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].squeeze(-1).sigmoid()]
    torch.save({"tensors": [*shapes, base, view.viewmat, view.K], "size": [view.width, view.height]}, out)


def trained_pipeline(scene: Path, steps: int):
    """Train `nrfgs-sh` with nerfstudio's defaults but for the size of the images and the number of steps."""
    from nerfstudio.scripts.train import _set_random_seed

    from nrfgs_ns.training.run import parse

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        options = {
            "--data": scene,
            "--output-dir": folder,
            "--max-num-iterations": steps,
            "--vis": "tensorboard",
            "--steps-per-eval-image": 10 * steps,
            "--steps-per-eval-all-images": 10 * steps,
            "--logging.profiler": "none",
            "--machine.device-type": "cpu",
            "--pipeline.model.num-downscales": 0,
            "--pipeline.datamanager.camera-res-scale-factor": TRAINED_AT,
        }
        config = parse(["nrfgs-sh", *(str(word) for option in options.items() for word in option)])
        config.save_config()
        _set_random_seed(config.machine.seed)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.train()
        return trainer.pipeline


def load_trained(path: Path) -> Scene:
    """What `train` has saved."""
    saved = torch.load(path, weights_only=True)
    *splats, viewmat, K = saved["tensors"]
    return Scene([t.clone().requires_grad_() for t in splats] + [viewmat, K], *saved["size"])


def ours(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, *camera) -> tuple:
    """What the model renders with."""
    p = project(means, quats, scales, *camera)
    return composite(p, colors[p.gaussian_ids], opacities[p.gaussian_ids])[:2]


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
    """MiB by which the peak of one forward and backward exceeds what the process held before. Linux only."""
    # A first small image loads libraries and starts threads.
    timed(ours, cloud(100, 32, 32), 1, warm=False)
    before = memory_kib("VmRSS")
    timed(ours, scene, 1, warm=False)
    return (memory_kib("VmHWM") - before) / 1024


def memory_kib(field: str) -> int:
    """A line of Linux's account of this process: VmRSS is what it holds now, VmHWM the most it ever held."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field))


def neighbour() -> float | None:
    """How many times longer a thread works on numbers of which another thread wrote half than on its own."""
    if torch.get_num_threads() == 1:
        return None
    numbers = torch.zeros(200_000)
    parts = numbers.split(25_000)  # each too small for torch to divide it among threads

    def fastest(write: Callable[[], object]) -> float:
        seconds = math.inf
        for _ in range(100):
            write()
            start = time.perf_counter()
            for part in parts:
                part.add_(1)
            seconds = min(seconds, time.perf_counter() - start)
        return seconds

    return round(fastest(lambda: numbers.add_(1)) / fastest(lambda: [part.add_(1) for part in parts]), 2)


def bind(threads: int) -> list[int]:
    """Keep this process and its children on as many physical cores as threads, sharing a cache where possible."""

    def listed(cpu: int, file: str) -> str:
        path = Path(f"/sys/devices/system/cpu/cpu{cpu}/{file}")
        return path.read_text().strip() if path.exists() else str(cpu)

    groups: dict[str, dict[str, int]] = {}  # the first hyperthread of each core, by the cache that it shares
    for cpu in sorted(os.sched_getaffinity(0)):
        cores = groups.setdefault(listed(cpu, "cache/index3/shared_cpu_list"), {})
        cores.setdefault(listed(cpu, "topology/thread_siblings_list"), cpu)
    by_size = sorted((list(cores.values()) for cores in groups.values()), key=len, reverse=True)
    chosen = [cpu for cores in by_size for cpu in cores][:threads]
    os.sched_setaffinity(0, chosen)
    return chosen


def measure(name: str, scene: Scene, arguments: argparse.Namespace) -> dict:
    """One row, printed and returned."""
    row: dict = {"splats": len(scene.tensors[0]), "image": [scene.width, scene.height], "neighbour": [neighbour()]}
    begin = time.perf_counter()
    rounds: list[dict[str, dict[str, float]]] = []
    if not arguments.no_loop:
        row["mean_difference"] = agree(scene)  # also the loop's unmeasured run
        if row["mean_difference"] > 1e-4:
            sys.exit(f"{name}: the two images differ by {row['mean_difference']:.1e} on average")
    while len(rounds) < arguments.rounds and (not rounds or time.perf_counter() - begin < arguments.budget):
        # In turns, so that a machine that slows down for a while slows both.
        rounds.append({"ours": timed(ours, scene, arguments.repeats)})
        if not arguments.no_loop:
            rounds[-1]["loop"] = timed(plain_loop, scene, 1, warm=False)
    for which in rounds[0]:
        row[which] = {key: statistics.median(r[which][key] for r in rounds) for key in rounds[0][which]}
    row["rounds"] = rounds
    row["load"] = round(os.getloadavg()[0], 1)
    row["neighbour"].append(neighbour())
    line = f"{name:24} ours {row['ours']['forward_ms']:6.0f} + {row['ours']['backward_ms']:6.0f} ms"
    if not arguments.no_loop:
        ratios = [sum(r["loop"].values()) / sum(r["ours"].values()) for r in rounds]
        fastest = [min(sum(r[which].values()) for r in rounds) for which in ("ours", "loop")]
        row["times_faster"] = statistics.median(ratios)
        row["times_faster_fastest"] = fastest[1] / fastest[0]
        line += f"   loop {row['loop']['forward_ms']:6.0f} + {row['loop']['backward_ms']:6.0f} ms"
        line += f"   {row['times_faster']:5.1f} ({min(ratios):.1f}-{max(ratios):.1f}) times faster"
        line += f", fastest rounds {row['times_faster_fastest']:.1f}"
    print(line, flush=True)
    return row


def again(*words: object) -> str:
    """Run this script in a process of its own, and return what it prints."""
    command = [sys.executable, "-m", "nrfgs_lab.timing.rasterizer_cpu", *map(str, words)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="splats x width x height")
    parser.add_argument("--scene", type=Path, help="a scene to train at an eighth of its size, seen at half its size")
    parser.add_argument("--scene-steps", type=int, default=1000, help="training steps of --scene")
    parser.add_argument("--config", type=Path, help="config.yml of a training, seen from its first camera at full size")
    parser.add_argument("--repeats", type=int, default=3, help="runs of ours in a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--budget", type=float, default=45, help="seconds after which a row begins no other round")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--no-bind", action="store_true", help="let the process wander over all cores")
    parser.add_argument("--no-loop", action="store_true", help="skip the baseline")
    parser.add_argument("--out", type=Path, default=Path("rasterizer_cpu.json"))
    parser.add_argument("--train", type=Path, metavar="FILE", help=argparse.SUPPRESS)
    parser.add_argument("--peak-memory", metavar="SIZE or FILE", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0)) if arguments.no_bind else bind(arguments.threads)
    torch.set_num_threads(arguments.threads)
    if arguments.peak_memory:
        is_file = arguments.peak_memory.endswith(".pt")
        print(peak_memory(load_trained(Path(arguments.peak_memory)) if is_file else cloud_of(arguments.peak_memory)))
        return
    if arguments.train:
        train(arguments.scene, arguments.config, arguments.scene_steps, arguments.train)
        return

    settings = {
        "machine": {"name": f"{os.cpu_count()} CPU cores", "cores": len(cores), "torch": torch.__version__},
        "threads": arguments.threads,
        "repeats": arguments.repeats,
        "results": {},
    }
    results = settings
    if arguments.out.exists():
        earlier = json.loads(arguments.out.read_text())
        if {**earlier, "results": {}} == settings:
            results = earlier
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "trained.pt"
        names = {size: size for size in arguments.sizes}
        if "50000x400x300" in names:
            names["50000x400x300 opaque"] = "50000x400x300 opaque"
        source = arguments.scene or (arguments.config and arguments.config.parent)
        if source:
            names[f"{source.resolve().name} trained"] = str(saved)
        common = ["--threads", arguments.threads, *["--no-bind"] * arguments.no_bind]
        for name, what in names.items():
            if name in results["results"]:
                print(f"{name:24} is in {arguments.out}", flush=True)
                continue
            if what == str(saved):
                source = ["--config", arguments.config] if arguments.config else ["--scene", arguments.scene]
                again("--train", saved, *source, "--scene-steps", arguments.scene_steps, *common)
            row = measure(name, load_trained(saved) if what == str(saved) else cloud_of(what), arguments)
            row["peak_memory_mib"] = float(again("--peak-memory", what, *common))
            print(f"{'':24} peak memory {row['peak_memory_mib']:.0f} MiB", flush=True)
            results["results"][name] = row
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            unfinished = arguments.out.with_suffix(".part")
            unfinished.write_text(json.dumps(results, indent=1) + "\n")
            unfinished.replace(arguments.out)


if __name__ == "__main__":
    main()
