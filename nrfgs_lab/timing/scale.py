# SPDX-License-Identifier: Apache-2.0
"""Time of a training step, frames per second and peak memory against numbers of splats and pixels, for five renderers.

    python -m nrfgs_lab.timing.scale --out scale.jsonl [--config TRAINING/config.yml]

All have the same splats, cameras and photographs, and growth has ended: discs on surfaces in a ring of cameras, or a
training's splats, thinned or repeated, and its cameras. `gsplat` and `faster-gs` are bare: no loader, but Adam and this
project's loss. NAME:unrecorded: without the step's CUDA graph. Cells take turns; those in the file are skipped.
"""

import gc
import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from operator import itemgetter
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils import writer
from PIL import Image
from torch import Tensor
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from nrfgs_lab.bench.measure import at_size, frames_per_second
from nrfgs_lab.bench.run import host_without_downloads
from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.training_run import machine, parse, set_up, synchronize
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.files import write_whole
from nrfgs_ns.image.ssim import photometric_loss
from nrfgs_ns.method_config import nrfgs_sh
from nrfgs_ns.model.pinholes import Pinholes
from nrfgs_ns.rasterizer import Pinhole
from nrfgs_ns.trained.loading import load_training
from nrfgs_ns.training.guard import TrainingStopped

HOSTED = {
    "nrfgs": {"densification": "error-guided,grow_until=0,stop_at=0", "dense-start": "off", "few-views": "off"},
    "nrfgs-sh": {"densification": "splatfacto,stop_split_at=0", "appearance.degree-interval": 1},
    "splatfacto": {"stop-split-at": 0, "sh-degree-interval": 1},
}
"""Methods that train in nerfstudio's loop -> options of their models after growth, with all harmonics."""
HEAD = {"densification": "splatfacto,stop_split_at=0"}
"""The same of other methods of this project."""
BARE = {"gsplat": "gsplat", "faster-gs": "FasterGSCudaBackend.torch_bindings"}
"""Renderers without a host -> modules that they need."""
PARSER = "nrfgs-data --orientation-method none --center-method none --auto-scale-poses False --downscale-factor 1"
CELL = "splats", "megapixels", "method", "repeat"
cell_of = itemgetter(*CELL)
GEOMETRY = "means", "scales", "quats", "opacities", "features_dc"
FRAMES = {"1080p": (1920, 1080), "4K": (3840, 2160)}
VIEWS = 16  # at most
WARM = 50
"""Steps before the clock starts."""
PROFILED = 10
"""Steps behind those on the clock, in which kernels are timed."""


class Stopwatch:
    """Milliseconds of a step and of the GPU's work in it, and peak memory, of a training with `steps` on the clock."""

    step_ms = gpu_ms = peak_bytes = 0

    def __init__(self, steps: int):
        self.end = WARM + steps
        self.steps = self.end + PROFILED + 1  # to be made in all
        self.cuda = torch.cuda.is_available()
        self.kernels = profile(activities=[ProfilerActivity.CUDA]) if self.cuda else None

    def before(self, step: int) -> None:
        """Call before each step, with its number."""
        if step in (0, WARM, self.end, self.end + PROFILED):
            synchronize()
        if step == 0 and self.cuda:
            torch.cuda.reset_peak_memory_stats()
        if step == WARM:
            self.start = perf_counter()
        if step == self.end:
            self.step_ms = 1e3 * (perf_counter() - self.start) / (self.end - WARM)
            if self.cuda:
                self.peak_bytes = torch.cuda.max_memory_allocated()
                self.kernels.start()
        if step == self.end + PROFILED and self.cuda:
            self.kernels.stop()
            events = [e for e in self.kernels.events() if e.device_type == DeviceType.CUDA and not e.is_user_annotation]
            self.gpu_ms = sum(event.time_range.elapsed_us() for event in events) / 1e3 / PROFILED


class Capture(NamedTuple):
    """What all renderers are given: splats, pinholes [V], and photographs, uint8 [H, W, 3]."""

    splats: dict[str, Tensor]
    cameras: Cameras
    photographs: list[Tensor]


@lru_cache(1)
def made(count: int) -> Capture:
    """Thin discs on a bumpy ball (half of them) and two walls around it and the cameras: the more, the smaller."""
    draw = torch.Generator().manual_seed(0)
    normals, spread, colors = torch.randn(3, count, 3, generator=draw)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    radii = torch.tensor([0.5] * 5 + [2.0] * 3 + [5.0] * 2)[torch.arange(count) * 10 // count, None]
    means = radii * normals * (1 + 0.1 * (9 * normals).sin().prod(dim=-1, keepdim=True))
    # A whole sphere is 4 pi, and these have 0.2 to 0.5 of the splats.
    scales = (radii * (12 / count) ** 0.5).log() + 0.5 * spread - torch.tensor([0.4, 0.4, 2.5])
    quats = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], dim=-1)  # z to normal
    splats = means, scales, quats, 2 * torch.randn(count, 1, generator=draw), colors
    angles = torch.arange(VIEWS) * 2 * math.pi / VIEWS
    back = torch.nn.functional.normalize(torch.stack([angles.cos(), angles.sin(), 0 * angles + 0.4], dim=-1), dim=-1)
    right = torch.stack([-angles.sin(), angles.cos(), 0 * angles], dim=-1)
    poses = torch.stack([right, back.cross(right, dim=-1), back, 1.5 * back], dim=-1)
    photographs = list((255 * torch.rand(VIEWS, 20, 30, 3, generator=draw)).byte())
    cameras = Cameras(poses, 26.0, 26.0, 15.0, 10.0, 30, 20)
    return Capture(dict(zip(GEOMETRY, splats, strict=True)), cameras, photographs)


@lru_cache(1)
def resampled(config: Path, count: int) -> Capture:
    """A training's splats, thinned, or repeated beside themselves, in sizes that cover as much, and its photographs."""
    pipeline = load_training(config, "inference").pipeline
    table, data = pipeline.model.gauss_params, pipeline.datamanager
    views = evenly_spaced(len(data.cached_train), VIEWS)
    draw = torch.Generator().manual_seed(0)
    present = len(table["means"])
    rows = torch.cat([torch.randperm(present, generator=draw) for _ in range(-(-count // present))])[:count]
    splats = {name: table[name].detach().cpu()[rows] for name in GEOMETRY}
    splats["means"] += (count > present) * torch.randn(count, 3, generator=draw) * splats["scales"].exp()
    splats["scales"] += 0.5 * math.log(present / count)
    photographs = [data.cached_train[view]["image"][..., :3].cpu() for view in views]
    return Capture(splats, data.train_dataset.cameras[torch.tensor(views)].to("cpu"), photographs)


def at_megapixels(capture: Capture, megapixels: float) -> Capture:
    """The capture with photographs of this size."""
    own = capture.cameras
    scale = (1e6 * megapixels / (own.width * own.height)).sqrt()
    sizes = [(scale * side).round().int() for side in (own.width, own.height)]
    cameras = Cameras(own.camera_to_worlds, *(scale * lens for lens in (own.fx, own.fy, own.cx, own.cy)), *sizes)
    places = zip(capture.photographs, torch.cat(sizes, dim=-1).tolist(), strict=True)
    images = [np.array(Image.fromarray(image.numpy()).resize(size)) for image, size in places]
    return Capture(capture.splats, cameras, [torch.from_numpy(image) for image in images])


def write_scene(capture: Capture, folder: Path) -> None:
    """Make a data set of the capture."""
    frames = []
    for index, image in enumerate(capture.photographs):
        c, name = capture.cameras[index], f"{index:04}.jpg"
        Image.fromarray(image.numpy()).save(folder / name, quality=95)
        lens = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
        frames.append({"file_path": name, "transform_matrix": [*c.camera_to_worlds.tolist(), [0, 0, 0, 1]]})
        frames[-1] |= {key: value.item() for key, value in lens.items()}
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}))


def trainer_of(method: str, scene: Path, device: str, watch: Stopwatch, splats: dict[str, Tensor]) -> Any:
    """A trainer of nerfstudio's before its first step, with these splats."""
    method, _, variant = method.partition(":")
    own = {"num-downscales": 0, "random-init": True, "num-random": 100, **HOSTED.get(method, HEAD)}
    own |= {"warmup-steps": 0, "photographs": "off"} if method != "splatfacto" else {}
    options = {"--machine.device-type": device, "--max-num-iterations": watch.steps, "--output-dir": scene / "out"}
    options |= {f"--pipeline.model.{name}": value for name, value in own.items()}
    words = [str(word) for option in options.items() for word in option]
    trainer = set_up(parse([method, *QUIET, *words, *PARSER.split(), "--data", str(scene)]))
    trainer.save_checkpoint = lambda step: None
    trainer.graphs = None if variant else getattr(trainer, "graphs", None)
    trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], watch.before))
    model, optimizers = trainer.pipeline.model, trainer.optimizers
    for name, old in list(model.gauss_params.items()):
        new = splats[name] if name in splats else 0.1 * torch.randn(len(splats["means"]), *old.shape[1:])
        model.gauss_params[name] = parameter = torch.nn.Parameter(new.to(model.device))
        optimizers.optimizers[name].param_groups[0]["params"] = optimizers.parameters[name] = [parameter]
    return trainer


def trained(method: str, capture: Capture, device: str, watch: Stopwatch) -> Any:
    """A trainer of nerfstudio's that has trained the capture's splats on its photographs."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, host_without_downloads(method):
        write_scene(capture, Path(folder))
        trainer = trainer_of(method, Path(folder), device, watch, capture.splats)
        trainer.train()
        writer.EVENT_WRITERS.clear()  # the next training would write to this one's folder, too
    return trainer


class Bare:
    """Splats with harmonics of degree 3, a rasterizer, and Adam: a training without a host."""

    def __init__(self, method: str, splats: dict[str, Tensor], device: str):
        self.device, self.library = torch.device(device), import_module(BARE[method])
        self.seen: dict[int, tuple[Cameras, Pinhole, list]] = {}
        self.draw = self.gsplat if method == "gsplat" else self.faster_gs
        table = {**splats, "features_rest": 0.1 * torch.randn(len(splats["means"]), 15, 3)}
        self.splats = {name: torch.nn.Parameter(value.to(self.device)) for name, value in table.items()}
        rates = nrfgs_sh.config.optimizers
        groups = [{"params": [s], "lr": rates[name]["optimizer"].lr} for name, s in self.splats.items()]
        adam = partial(torch.optim.Adam, fused=True) if method == "gsplat" else self.library.FusedAdam
        self.adam = adam(groups, lr=0.0, eps=1e-15)

    def step(self, camera: Cameras, photograph: Tensor) -> None:
        photometric_loss(self.image(camera), photograph / 255, 0.2).backward()
        self.adam.step()
        self.adam.zero_grad()

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras) -> dict[str, Tensor]:
        """As nerfstudio's models."""
        return {"rgb": self.image(camera).clamp(0, 1)}

    def image(self, camera: Cameras) -> Tensor:
        """The image [H, W, 3]; a camera is converted once, since that takes the host longer than a step."""
        if id(camera) not in self.seen:
            pinhole = Pinholes().of_full_size(camera, self.device)
            self.seen[id(camera)] = camera, pinhole, pinhole.K[0].tolist()
        return self.draw(*self.seen[id(camera)][1:])

    def gsplat(self, seen: Pinhole, K: list) -> Tensor:
        s = self.splats
        harmonics = torch.cat([s["features_dc"][:, None], s["features_rest"]], dim=1)
        matrices = seen.viewmat, seen.K, seen.width, seen.height
        table = s["means"], s["quats"], s["scales"].exp(), s["opacities"].sigmoid().flatten(), harmonics
        return self.library.rasterization(*table, *matrices, sh_degree=3, packed=False)[0][0]

    def faster_gs(self, seen: Pinhole, K: list) -> Tensor:
        s, black = self.splats, torch.zeros(3, device=self.device)
        lens = seen.width, seen.height, K[0][0], K[1][1], K[0][2], K[1][2]
        settings = self.library.RasterizerSettings(seen.viewmat[0], seen.center, black, 16, *lens, 0.01, 1e10, False)
        table = (*(s[name] for name in GEOMETRY[:4]), s["features_dc"][:, None], s["features_rest"])
        if not torch.is_grad_enabled():
            return self.library.rasterize(*table, settings, to_chw=False)
        return self.library.diff_rasterize(*table, torch.empty(0), settings).permute(1, 2, 0)


@dataclass
class Scale:
    """Cells of the table, each a line of JSON in the file `out`."""

    out: Path
    config: Path | None = None  # config.yml of a training whose splats, cameras and photographs replace made ones
    methods: tuple[str, ...] = (*HOSTED, *BARE)
    splats: tuple[int, ...] = (300_000, 1_000_000, 3_000_000)
    megapixels: tuple[float, ...] = (0.4, 2.0, 8.0)
    frames: tuple[str, ...] = tuple(FRAMES)  # sizes for frames per second, beside the first of megapixels
    repeats: int = 3
    steps: int = 100  # on the clock

    def main(self) -> None:
        records = lines_of(self.out)
        device = "cuda" if torch.cuda.is_available() else "cpu"
        done = {cell_of(record) for record in records}
        needs = {of: BARE.get(of, "nerfstudio") for of in self.methods}
        cuda = {of for of in needs if device == "cuda" and find_spec(needs[of].partition(".")[0])}
        methods = [of for of in needs if of.startswith("nrfgs") or of in cuda]
        print(*(f"{of} is left out: it needs CUDA and {needs[of]}." for of in needs if of not in methods), sep="\n")
        for turn, count, megapixels in product(range(self.repeats), self.splats, self.megapixels):
            cells = [cell for cell in product([count], [megapixels], methods, [turn]) if cell not in done]
            if not cells:
                continue
            capture = at_megapixels(resampled(self.config, count) if self.config else made(count), megapixels)
            for cell in cells:
                torch.manual_seed(0)
                sizes = self.frames if megapixels == self.megapixels[0] else ()
                measured = partial(self.measure, cell[2], capture, sizes)
                add_line(self.out, records, dict(zip(CELL, cell, strict=True)), measured)

    def measure(self, method: str, capture: Capture, sizes: tuple[str, ...]) -> dict[str, Any]:
        """Time and memory of a training's steps, and its frames per second at sizes of `FRAMES`."""
        device = "cuda" if torch.cuda.is_available() else "cpu"
        watch = Stopwatch(self.steps)
        cameras = capture.cameras.to(device)
        views = [cameras[index : index + 1] for index in range(len(cameras))]
        if method in BARE:
            model = Bare(method, capture.splats, device)
            photographs = [image.to(device) for image in capture.photographs]
            for step in range(watch.steps):
                watch.before(step)
                model.step(views[step % len(views)], photographs[step % len(views)])
        else:
            trainer = trained(method, capture, device, watch)
            trainer.graphs = None
            model = trainer.pipeline.model.eval()
        large = {size: [at_size(view, *FRAMES[size]) for view in views] for size in sizes}
        frames = {size: frames_per_second(model, cameras) for size, cameras in large.items()}
        return {"step_ms": watch.step_ms, "gpu_ms": watch.gpu_ms, "peak_mb": watch.peak_bytes / 1e6, **frames}


def lines_of(file: Path) -> list[dict[str, Any]]:
    """The records in a file of lines of JSON; none where there is no file."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def add_line(file: Path, records: list[dict], cell: dict[str, Any], measure: Callable[[], dict[str, Any]]) -> None:
    """Measure a cell, add its record to those in the file, and print it; a training that stops leaves its reason."""
    gc.collect()
    torch.cuda.empty_cache()
    records.append(cell | {"machine": machine()})
    try:
        records[-1] |= measure()
    except (torch.OutOfMemoryError, TrainingStopped) as error:
        records[-1]["failed"] = str(error).partition("\n")[0]
    write_whole(file, "".join(json.dumps(record) + "\n" for record in records))
    print(records[-1], flush=True)


if __name__ == "__main__":
    tyro.cli(Scale).main()
