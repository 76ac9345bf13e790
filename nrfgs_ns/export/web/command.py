# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export web`: what the page holds, and where it begins."""

import io
import math
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote, urljoin

import torch
from nerfstudio.cameras.cameras import Cameras
from PIL import Image

from nrfgs_ns.data.pictures import picture_names
from nrfgs_ns.data.views import evenly_spaced, in_view
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.command import SCENE, Web
from nrfgs_ns.export.compact import load_field, write_file
from nrfgs_ns.export.web.guide import read_notes, read_tour
from nrfgs_ns.export.web.page import page
from nrfgs_ns.files import write_whole
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.threads import draws_small, few_threads
from nrfgs_ns.trained.loading import finish, lost

POSTER_SIDE = 960
"""Longest side of the poster, pixels."""
MOST_POINTS = 20_000
"""Splats from which a photograph's distance to its subject is estimated."""


def export_web(load_config: Path, options: Web) -> None:
    """Write a page, or into a folder a page beside its scene; see `nrfgs export web --help`."""
    output, alone, address = options.output, options.alone, options.address
    if address is not None and not address.startswith(("https://", "http://")):
        raise InputError(f"--address {address} is no web address. Give all of it, with https://.")
    pipeline = load_field(load_config, options.measure)
    names = picture_names(pipeline.datamanager.train_dataset.image_filenames)
    guide = {"tour": read_tour(options.tour, names), "notes": read_notes(options.notes), "rotate": options.rotate}
    with few_threads(draws_small(pipeline)):
        about, poster = surroundings(pipeline, names)
        title = output.stem if options.title is None else options.title
        picture, below = options.picture, alone or address is None or address.lower().endswith((".html", ".htm"))
        preview = "" if address is None else urljoin(address if below else f"{address}/", quote(picture.name))
        around = len(page(about | guide, poster, b"" if alone else SCENE, title, options.author, preview).encode())
        with TemporaryDirectory() as temporary:
            file = Path(temporary) / SCENE
            total = lambda size: around + (-(-size // 3) * 4 if alone else size)  # noqa: E731 -- base64 in a page
            _, numbers = write_file(pipeline, load_config, file, options, total)
            scene = file.read_bytes()
    text = page(about | guide, poster, scene if alone else SCENE, title, options.author, preview)
    contents = {output: text.encode()} if alone else {output / SCENE: scene, output / "index.html": text.encode()}
    for path, content in (contents | ({picture: poster} if preview else {})).items():
        write_whole(path, content)
    size = sum(map(len, contents.values()))
    name = about["photographs"][about["start"]]["name"]
    lines = [
        f"{output}: {numbers['written']:,} splats, {size / 1e6:.2f} MB; 3DGS's PLY of as many splats has "
        f"{numbers['ply_bytes'] / 1e6:.2f} MB. It begins where {name} was taken."
    ]
    lines += [lost(numbers)] if options.measure else []
    lines += [f"{picture}: the picture for {preview}."] if preview else []
    lines.append("Open it in a browser." if alone else "Put the folder on a web server: see docs/web.md.")
    finish(lines, numbers | {"bytes": size, "scene_bytes": len(scene), "start": name}, options.report)


@torch.no_grad()
def surroundings(pipeline, names: list[str]) -> tuple[dict[str, Any], bytes]:
    """The scripts' values besides the scene, and a JPEG of the training view at which the page begins: the one that the
    model draws best (PSNR) of at most eight, evenly spaced.

    The values: "photographs", each with its name, pose [12] (camera to world, x right, y up, z backwards, row by row),
    lens (focal lengths, principal point) and size in pixels, and "distance" to the subject; "start", an index; "up", a
    direction.
    """
    model, data = pipeline.model, pipeline.datamanager
    images, cameras = data.cached_train, data.train_dataset.cameras
    starts = []
    for i in evenly_spaced(len(cameras), 8):
        outputs = model.get_outputs_for_camera(cameras[i : i + 1].to(model.device))
        score = psnr(outputs["rgb"], model.truth_of(images[i], outputs["background"]), model.mask_of(images[i]))
        starts.append((-math.inf if score is None else score, i, outputs["rgb"]))  # None: all is masked
    _, start, poster = max(starts, key=itemgetter(0))

    poses = cameras.camera_to_worlds.cpu()
    up = poses[:, :3, 1].mean(dim=0)
    up = up / up.norm() if up.norm() > 1e-3 else up.new_tensor([0.0, 0.0, 1.0])
    opaque = model.gauss_params["means"][model.gauss_params["opacities"][:, 0] > 0]
    means = opaque[:: max(1, -(-len(opaque) // MOST_POINTS))].cpu()
    distances = [distance(cameras[i : i + 1], means) for i in range(len(cameras))]
    known = sorted(filter(None, distances))
    typical = known[len(known) // 2] if known else model.scene_unit
    photographs = [
        {
            "name": name,
            "pose": _rounded(poses[i].flatten()),
            "lens": _rounded(torch.stack([getattr(cameras, part)[i, 0] for part in ("fx", "fy", "cx", "cy")])),
            "size": [int(cameras.width[i]), int(cameras.height[i])],
            "distance": distances[i] or typical,
        }
        for i, name in enumerate(names)
    ]
    return {"photographs": photographs, "start": start, "up": _rounded(up)}, _jpeg(poster)


def distance(camera: Cameras, means: torch.Tensor) -> float | None:
    """Median depth of the means in the middle of a camera's image, half as wide and high; None if there are none."""
    middle, depths = in_view(means, camera, 0.5)
    return float(depths[middle].median()) if middle.any() else None


def _rounded(values: torch.Tensor) -> list[float]:
    """Numbers with float32's digits."""
    return [float(f"{value:.7g}") for value in values.tolist()]


def _jpeg(picture: torch.Tensor) -> bytes:
    """An image [H, W, 3] in [0, 1], made smaller if it is large."""
    image = Image.fromarray((picture * 255).round().byte().cpu().numpy())
    image.thumbnail((POSTER_SIDE, POSTER_SIDE))
    stream = io.BytesIO()
    image.save(stream, "jpeg", quality=80)
    return stream.getvalue()
