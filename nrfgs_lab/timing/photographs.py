# SPDX-License-Identifier: Apache-2.0
"""How long a training takes to read many or large photographs before its first step, and how much memory.

    python -m nrfgs_lab.timing.photographs --out photographs.json [--data CAPTURE ...]

Without --data photographs are made for it: JPEGs of a gradient under noise, from a ring of cameras, and points. Each
capture is read in a process of its own, the files in the system's cache. `own_bytes` is what the process had for itself
at most: the system takes pages of mapped files back when it needs them, and they do not count.
"""

import json
import os
import pkgutil
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np
import tyro
from PIL import Image

from nrfgs_lab.bench.spec import QUIET
from nrfgs_lab.scenes.dataset import write_ply
from nrfgs_lab.training_run import machine, parse
from nrfgs_ns.files import write_whole

CAPTURES = {
    "30 of 12 megapixels": (30, 4000, 3000, ""),
    "30 of 12 megapixels, a quarter of their size": (30, 4000, 3000, "nrfgs-data --downscale-factor 4"),
    "2,000 of 2 megapixels": (2000, 1632, 1224, ""),
    "2,000 of 2 megapixels, in files": (2000, 1632, 1224, "--pipeline.datamanager.image-memory 0"),
}
"""Number, width and height of photographs, and options of the training."""
PARTS = {
    "datamanager": "nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanager.__init__",
    "images": "nrfgs_ns.data.datamanager.NrfgsDatamanager.load_all_images",
    "exposures": "nrfgs_ns.training.pipeline.photograph_model",
    "points": "nrfgs_ns.training.trainer.start_with_dense_points",
}
"""What is timed by itself: the data set's checks, decoding, comparing photographs, points from them."""


def make(folder: Path, count: int, width: int, height: int) -> None:
    """Write a data set of so many photographs, which look at a ball of points from a circle."""
    (folder / "images").mkdir(parents=True)
    draw, frames = np.random.default_rng(0), []
    noise = Image.fromarray(draw.integers(0, 90, (height // 4, width // 4, 3), dtype=np.uint8)).resize((width, height))
    ramp, noise = np.linspace(0, 150, width)[:, None], np.array(noise)
    for index in range(count):
        picture = (np.roll(noise, 97 * index, axis=1) + ramp * [1.0, 0.7, 0.4]).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"images/{index:05}.jpg", quality=90)
        angle = 2 * np.pi * index / count
        back = np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([-back[1], back[0], 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 4 * back], axis=1)
        frames.append({"file_path": f"images/{index:05}.jpg", "transform_matrix": pose.tolist()})
    points = draw.normal(size=(20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    write_ply(folder / "sparse.ply", points, draw.integers(0, 256, points.shape, dtype=np.uint8))
    lens = {"fl_x": width, "fl_y": width, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    content = {"camera_model": "PINHOLE", **lens, "ply_file_path": "sparse.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def read(folder: str, out: str, options: str) -> None:
    """Set a training up, and print what that took as JSON."""
    peak, over, seconds = [own_bytes()], threading.Event(), {}

    def watch() -> None:
        while not over.wait(0.02):
            peak[0] = max(peak[0], own_bytes())

    def timed(name: str, part: Callable, *args: Any, **kwargs: Any) -> Any:
        start = perf_counter()
        result = part(*args, **kwargs)
        seconds[name] = perf_counter() - start
        return result

    config = parse(["nrfgs", "--data", folder, "--output-dir", out, *QUIET, *options.split()])
    for name, path in PARTS.items():
        owner, attribute = pkgutil.resolve_name(path.rpartition(".")[0]), path.rpartition(".")[2]
        part = getattr(owner, attribute)
        setattr(owner, attribute, lambda *args, of=(name, part), **kwargs: timed(*of, *args, **kwargs))
    before, start = peak[0], process_time()
    threading.Thread(target=watch, daemon=True).start()
    trainer = config.setup(local_rank=0, world_size=1)
    timed("all", trainer.setup)
    over.set()
    data = trainer.pipeline.datamanager
    images = [*data.cached_train, *data.cached_eval]
    record = {"size": list(images[0]["image"].shape[1::-1]), "kept_in": data._storage, "seconds": seconds}
    own = data.train_dataparser_outputs.metadata.get("points3D_xyz", ())
    record |= {"views": len(data.train_dataset), "points": len(own), "splats": trainer.pipeline.model.num_points}
    record |= {"cpu_seconds": process_time() - start, "own_bytes": peak[0] - before}
    print(json.dumps(record | {"decoded_bytes": sum(image["image"].nbytes for image in images)}))


def own_bytes() -> int:
    """Bytes that are this process's alone."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon:"))


def reading(folder: Path, options: str) -> dict[str, Any]:
    """The record of one capture."""
    with TemporaryDirectory() as work:
        code = "import sys; from nrfgs_lab.timing.photographs import read; read(*sys.argv[1:])"
        command = [sys.executable, "-c", code, str(folder), f"{work}/out", options]
        environment = {**os.environ, "XDG_CACHE_HOME": f"{work}/cache"}
        said = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    return {"machine": machine(), **json.loads(said.splitlines()[-1])}


@dataclass
class Photographs:
    """Measure the reading of captures."""

    out: Path  # JSON file for the records
    data: tuple[Path, ...] = ()  # captures that are there, instead of those that are made

    def main(self) -> None:
        records = {folder.name: reading(folder, "") for folder in self.data}
        for name, (*shape, options) in () if self.data else CAPTURES.items():
            with TemporaryDirectory() as folder:
                make(Path(folder, "capture"), *shape)
                records[name] = reading(Path(folder, "capture"), options)
        write_whole(self.out, json.dumps({"study": self.out.stem, "records": records}, indent=1) + "\n")


if __name__ == "__main__":
    tyro.cli(Photographs).main()
