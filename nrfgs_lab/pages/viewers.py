# SPDX-License-Identifier: Apache-2.0
"""Seconds for a picture in this project's page, SuperSplat's viewer and Spark: the same splats, in one browser.

    npm pack @playcanvas/supersplat-viewer@1.36.2 @sparkjsdev/spark@2.2.0 three@0.180.0     # in the folder PACKAGES
    python -m nrfgs_lab.pages.viewers PACKAGES RECORD.json --splats 250000

The page has random latents and an untrained network; "base" is the page with base colours; the others have a PLY file
with random harmonics of degree 3. Before each picture the camera goes further around; viewers take turns. A picture is
a frame's: colours for the camera, projection, blending, to the last pixel. Sorting is waited for, off the clock.
"""

import argparse
import base64
import io
import json
import math
import os
import tarfile
import threading
from collections.abc import Sequence
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

from nrfgs_lab.pages.pictures import chromium
from nrfgs_lab.timing.scale import made
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.format import container
from nrfgs_ns.export.frames import Y_DOWN
from nrfgs_ns.export.ply import write_splats
from nrfgs_ns.export.web.page import page
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model.harmonics_fit import PlainSplats

STEP = 0.02  # radians between pictures, as `nrfgs.measure`
FOCAL = 0.87  # widths of a picture, as `timing.scale`'s
HERE = Path(__file__).parent
PACKAGES = {"supersplat": "playcanvas-supersplat-viewer", "spark": "sparkjsdev-spark", "three": "three"}
OTHER = "supersplat/public/index.html?webgl&noui&settings=../../settings.json&content=../../scene.ply"
VIEWERS = {"page": "page.html", "base": "page.html", "supersplat": OTHER, "spark": "viewers.html"}  # as in viewers.js


def write_scene(folder: Path, count: int, size: Sequence[int], cameras: int) -> None:
    """Write the page, the PLY file, and what the others need beside their packages."""
    torch.manual_seed(0)
    splats, head = made(count).splats, NrfConfig(output_init="default").setup().requires_grad_(False)
    field = Field(head, splats | {"latents": torch.randn(count, head.config.latent_dim)})
    scene = container(*encode(field, {"rasterize_mode": "classic", "background": [0.0] * 3}))
    plain = PlainSplats(**splats, features_rest=0.05 * torch.randn(count, 15, 3))
    write_splats(Y_DOWN.moved(plain), folder / "scene.ply")

    eyes = [[1.4 * math.cos(STEP * k), -1.4 * math.sin(STEP * k), 0.55] for k in range(cameras)]  # the page's way
    distance, focal, right = math.hypot(*eyes[0]), FOCAL * size[0], torch.tensor([0.0, 1.0, 0.0])
    back = torch.tensor(eyes[0]) / distance
    pose = torch.stack([right, torch.linalg.cross(back, right), back, distance * back], dim=1).flatten().tolist()
    photograph = {"name": "0", "pose": pose, "lens": [focal, focal, size[0] / 2, size[1] / 2], "size": list(size)}
    about = {"photographs": [photograph | {"distance": distance}], "start": 0, "up": [0, 0, 1]}
    Image.new("RGB", (1, 1)).save(poster := io.BytesIO(), "jpeg")
    (folder / "page.html").write_text(page(about, poster.getvalue(), scene, "Discs"))

    across, down = (math.degrees(2 * math.atan(side / 2 / focal)) for side in size)
    (folder / "cameras.json").write_text(json.dumps({"fov": down, "eyes": [[x, z, -y] for x, y, z in eyes]}))
    (folder / "viewers.html").write_text((HERE / "viewers.html").read_text())
    keys = {"position": [value for x, y, z in eyes for value in (-x, z, y)], "target": [0] * 3 * cameras}
    track = {"name": "around", "duration": cameras, "frameRate": 1, "target": "camera", "loopMode": "none"}
    track |= {"interpolation": "spline", "keyframes": {"times": list(range(cameras)), "values": keys}}
    settings = {"camera": {"fov": across, "startAnim": "animTrack"}, "background": {}, "animTracks": [track]}
    (folder / "settings.json").write_text(json.dumps(settings))


def measured(folder: Path, viewers: Sequence[str], size: Sequence[int], pictures: int) -> dict[str, Any]:
    """Seconds of each viewer's pictures, and "images" [H, W, 3] in [0, 1] from the last camera."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, chromium() as browser:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        tabs, seconds, images = {}, {name: [] for name in viewers}, {}
        for name in viewers:
            tabs[name] = browser.new_page(viewport={"width": size[0], "height": size[1]})
            tabs[name].add_init_script(path=HERE / "viewers.js")
            tabs[name].goto(f"http://127.0.0.1:{server.server_port}/{VIEWERS[name]}")
            tabs[name].evaluate(f"viewers.{name}.ready()")
        for camera in range(1, pictures + 2):
            for name, tab in tabs.items():
                seconds[name].append(round(tab.evaluate(f"viewers.{name}.draw({camera})"), 4))
                tab.evaluate(f"viewers.{name}.sorted()")
        for name, tab in tabs.items():
            data = base64.b64decode(tab.evaluate(f"viewers.{name}.picture({camera})").partition(",")[2])
            images[name] = torch.from_numpy(np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / np.float32(255))
        server.shutdown()
        rest = {name: values[1:] for name, values in seconds.items()}  # the first compiles, and has no order
        return {"browser": browser.version, "seconds": rest, "images": images}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("packages", type=Path, help="folder of npm's packages")
    parser.add_argument("record", type=Path, help="JSON to write")
    parser.add_argument("--splats", type=int, default=250_000)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), help="width and height, pixels")
    parser.add_argument("--pictures", type=int, default=5, help="of each viewer")
    options = parser.parse_args()
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name, package in PACKAGES.items():
            (path,) = options.packages.glob(f"{package}-[0-9]*.tgz")
            tarfile.open(path).extractall(folder, filter="data")
            (folder / "package").rename(folder / name)
        versions = {name: json.loads((folder / name / "package.json").read_text())["version"] for name in PACKAGES}
        write_scene(folder, options.splats, options.size, options.pictures + 2)
        load = os.getloadavg()[0]
        record = measured(folder, list(VIEWERS), options.size, options.pictures)
    images = record.pop("images")
    pairs = {f"{a}, {b}": round(psnr(images[a], images[b]), 2) for a, b in combinations(images, 2)}
    about = {"splats": options.splats, "size": list(options.size), "cores": os.cpu_count(), "versions": versions}
    about |= {"pictures": options.pictures, "load_average": [load, os.getloadavg()[0]], **record, "psnr": pairs}
    options.record.write_text(json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    main()
