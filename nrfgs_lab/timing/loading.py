# SPDX-License-Identifier: Apache-2.0
"""How long many photographs take to be checked and read, and how much memory.

    python -m nrfgs_lab.timing.loading --out results/loading.json --photographs 2000 --size 600 400

Photographs are made for it: JPEGs of smooth noise, with a lens that must be undistorted. Each way of keeping them is
measured in a process of its own, on the host, the files in the system's cache. Memory is what the process has for
itself: pages of mapped files, which the system takes back when it needs them, do not count.
"""

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro
from PIL import Image

from nrfgs_ns.files import write_whole
from nrfgs_ns.training.run import machine

WAYS = {
    "nerfstudio, float32": {"_own": False},
    "nerfstudio, uint8": {"_own": False, "cache_images_type": "uint8"},
    "memory": {"_own": True},
    "files, made": {"_own": True, "image_memory": 0.0},
    "files, found": {"_own": True, "image_memory": 0.0},
}
"""Options of the datamanager."""


@dataclass
class Loading:
    """Measure the reading of many photographs."""

    out: Path
    """JSON file for the record"""
    photographs: int = 2000
    """how many"""
    size: tuple[int, int] = (600, 400)
    """width and height, pixels"""
    workers: int | None = None
    """threads of this package's reading; None: one for each processor"""

    def main(self) -> None:
        with TemporaryDirectory() as folder:
            capture, cache = Path(folder, "capture"), Path(folder, "cache")
            make(capture, self.photographs, self.size)
            ways = {name: measured(capture, cache, options, self.workers) for name, options in WAYS.items()}
        width, height = self.size
        content = {
            "command": f"python -m nrfgs_lab.timing.loading --out {self.out.as_posix()} --photographs "
            f"{self.photographs} --size {width} {height}",
            "machine": machine(),
            "decoded_bytes": 3 * width * height * self.photographs,
            "ways": ways,
        }
        write_whole(self.out, json.dumps(content, indent=1) + "\n")
        print(json.dumps(content, indent=1))


def make(folder: Path, count: int, size: tuple[int, int]) -> None:
    """Write a data set of so many photographs, which look at the middle from a circle."""
    width, height = size
    (folder / "images").mkdir(parents=True)
    generator = np.random.default_rng(0)
    looks = [
        Image.fromarray(generator.integers(0, 256, (height // 16, width // 16, 3), dtype=np.uint8)).resize(size)
        for _ in range(8)
    ]
    frames = []
    for k in range(count):
        looks[k % 8].save(folder / f"images/{k:05}.jpg", quality=90)
        angle = 2 * np.pi * k / count
        back = np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([-back[1], back[0], 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 3 * back], axis=1)
        frames.append({"file_path": f"images/{k:05}.jpg", "transform_matrix": pose.tolist()})
    lens = {"fl_x": width, "fl_y": width, "cx": width / 2, "cy": height / 2, "w": width, "h": height, "k1": 0.05}
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **lens, "frames": frames}))


def measured(capture: Path, cache: Path, options: dict, workers: int | None) -> dict:
    """What a process says that reads the data set."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    words = [json.dumps({**options, "data": str(capture), "workers": workers})]
    code = "from nrfgs_lab.timing.loading import child; child()"
    said = subprocess.run(
        [sys.executable, "-c", code, *words], env=environment, check=True, capture_output=True, text=True
    )
    return json.loads(said.stdout.splitlines()[-1])


def child() -> None:
    """Read a data set, and say what that took."""
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from nrfgs_ns.data.datamanager import NrfgsDatamanagerConfig
    from nrfgs_ns.data.dataparser import NrfgsDataParserConfig

    options = json.loads(sys.argv[1])
    own, data, workers = options.pop("_own"), Path(options.pop("data")), options.pop("workers")
    peak, over = [0], threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            peak[0] = max(peak[0], own_memory())

    before = own_memory()
    threading.Thread(target=watch, daemon=True).start()
    start, own_time = time.perf_counter(), time.process_time()
    if own:
        parser = NrfgsDataParserConfig(data=data, load_3D_points=False)
        manager = NrfgsDatamanagerConfig(dataparser=parser, max_thread_workers=workers, **options)
    else:
        parser = NerfstudioDataParserConfig(data=data, load_3D_points=False, eval_mode="interval")
        manager = FullImageDatamanagerConfig(dataparser=parser, **options)
    manager = manager.setup(device="cpu")
    checked = time.perf_counter()
    if not own:  # it would pin more than 500 images, which needs a GPU
        manager.config.cache_images = "gpu"
    count = len(manager.cached_train) + len(manager.cached_eval)
    read = time.perf_counter()
    for step in range(200):
        manager.next_train(step)[1]["image"][::10].sum()
    over.set()
    numbers = {
        "photographs": count,
        "seconds_to_check": checked - start,
        "seconds_to_read": read - checked,
        "cpu_seconds": time.process_time() - own_time,
        "peak_bytes": max(peak[0], own_memory()) - before,
    }
    print(json.dumps(numbers))


def own_memory() -> int:
    """Bytes that are this process's alone."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon:"))


if __name__ == "__main__":
    tyro.cli(Loading).main()
