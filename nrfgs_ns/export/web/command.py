# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export web`: what the page holds, and where it begins."""

import io
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from PIL import Image

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.reduce import input_columns
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.format import write_container
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.errors import InputError
from nrfgs_ns.export.compact import check_head, measure_file, packed, write_config
from nrfgs_ns.export.options import CompactOptions, WebOptions
from nrfgs_ns.export.web.page import page
from nrfgs_ns.files import whole
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model.pinhole import pinhole
from nrfgs_ns.threads import few_threads
from nrfgs_ns.trained.loading import finish, load_model, lost

SCENE = "scene.nrf"
"""Name of the scene's file in a folder."""
POSTER_SIDE = 960
"""Longest side of the poster, pixels."""
MOST_WEIGHTS = 1024
"""Vectors of four that a uniform block holds on every device with WebGL 2 (16 KiB)."""
MOST_POINTS = 20_000
"""Splats that tell a photograph's distance to its subject."""


def export_web(
    load_config: Path, output: Path, options: CompactOptions, web: WebOptions, measure: bool, report: Path | None
) -> None:
    """Write a page, or into a folder a page beside its scene; see `nrfgs export web --help`."""
    alone = output.suffix.lower() in (".html", ".htm")
    with few_threads() as threads:
        pipeline = load_model(load_config, "test")
        threads.suit_to(pipeline)
        check_head(pipeline.model.head, load_config)
        if (vectors := weight_vectors(pipeline.model.head.config)) > MOST_WEIGHTS:
            raise InputError(
                f"{load_config}: the field's weights fill {vectors} vectors of a shader, and some phones have room for "
                f"{MOST_WEIGHTS}. Train with a smaller hidden_width, or fewer num_bands."
            )
        header, streams, numbers = packed(pipeline, options)
        about, poster = surroundings(pipeline)
        with TemporaryDirectory() as temporary:
            file = Path(temporary) / SCENE
            scene_bytes = write_container(file, header, streams)
            scene = file.read_bytes()
            losses = measure_file(pipeline, write_config(load_config, file, decode(file).config)) if measure else {}
    title = output.stem if web.title is None else web.title
    text = page(about, poster, scene if alone else SCENE, title, web.author)
    contents = {output: text.encode()} if alone else {output / SCENE: scene, output / "index.html": text.encode()}
    for path, content in contents.items():
        with whole(path) as aside:
            aside.write_bytes(content)

    size = sum(map(len, contents.values()))
    name = about["photographs"][about["start"]]["name"]
    lines = [
        f"{output}: {numbers['written']:,} splats, {size / 1e6:.2f} MB; 3DGS's PLY of as many splats has "
        f"{numbers['ply_bytes'] / 1e6:.2f} MB. It begins where {name} was taken."
    ]
    lines += [lost(losses)] if measure else []
    lines.append("Open it in a browser." if alone else "Put the folder on a web server: see docs/web.md.")
    finish(lines, numbers | {"bytes": size, "scene_bytes": scene_bytes, "start": name, **losses}, report)


def weight_vectors(config: NrfConfig) -> int:
    """Vectors of four that the page's shader reads for a view (`viewWeights` in field.js)."""
    branches = {"low": config.hidden_width if config.split_bands else 2 * config.hidden_width}
    if config.split_bands and config.num_bands > 1:
        branches["high"] = config.hidden_width
    total = 0
    for branch, units in branches.items():
        columns = input_columns(config, branch)
        view = sum(len(found) for name, found in columns.items() if name not in ("latents", "color", "opacity"))
        total += -(-units // 4) * (view + 4) + 1
    return total


@torch.no_grad()
def surroundings(pipeline) -> tuple[dict[str, Any], bytes]:
    """The scripts' values besides the scene, and a JPEG of the training view at which the page begins: the one that the
    model draws best (PSNR) of at most eight, evenly spaced.

    The values: "photographs", each with its name, pose [12] (camera to world, x right, y up, z backwards, row by row),
    lens (focal lengths, principal point) and size in pixels, and "distance" to the subject; "start", an index; "up", a
    direction; "nearest", the shortest distance to the point that is orbited; "speed", units a second.
    """
    model, data = pipeline.model, pipeline.datamanager
    images = data.cached_train  # before the cameras: undistortion crops them while it loads the images
    cameras = data.train_dataset.cameras
    best, start, poster = float("-inf"), 0, None
    for i in evenly_spaced(len(cameras), 8):
        camera = cameras[i : i + 1].to(model.device)
        outputs = model.get_outputs_for_camera(camera)
        truth = model.truth_of(images[i], outputs["background"])
        score = psnr(outputs["rgb"], truth, model.mask_of(images[i]))
        if poster is None or (score is not None and score > best):
            best, start, poster = score if score is not None else best, i, outputs["rgb"]

    poses = cameras.camera_to_worlds.cpu()
    up = poses[:, :3, 1].mean(dim=0)
    up = up / up.norm() if up.norm() > 1e-3 else up.new_tensor([0.0, 0.0, 1.0])
    opaque = model.gauss_params["means"][model.gauss_params["opacities"][:, 0] > 0]
    means = opaque[:: max(1, -(-len(opaque) // MOST_POINTS))].cpu()
    photographs = [
        {
            "name": Path(name).name,
            "pose": _rounded(poses[i].flatten()),
            "lens": _rounded(torch.stack([getattr(cameras, part)[i, 0] for part in ("fx", "fy", "cx", "cy")])),
            "size": [int(cameras.width[i]), int(cameras.height[i])],
            "distance": distance(cameras[i : i + 1], means),
        }
        for i, name in enumerate(data.train_dataset.image_filenames)
    ]
    known = sorted(view["distance"] for view in photographs if view["distance"] is not None)
    typical = known[len(known) // 2] if known else model.scene_unit
    for view in photographs:
        view["distance"] = typical if view["distance"] is None else view["distance"]
    places = {"photographs": photographs, "start": start, "up": _rounded(up)}
    return places | {"nearest": typical / 50, "speed": typical / 2}, _jpeg(poster)


def distance(camera: Cameras, means: torch.Tensor) -> float | None:
    """Median depth of the means in the middle of a camera's picture, half as wide and high; None if there are none."""
    seen = pinhole(camera, camera.camera_to_worlds.cpu().reshape(1, 3, 4), 1)
    points = means @ seen.viewmat[0, :3, :3].T + seen.viewmat[0, :3, 3]
    pixels = points @ seen.K[0].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    size = pixels.new_tensor([seen.width, seen.height])
    middle = ((pixels / size - 0.5).abs() < 0.25).all(dim=1) & (points[:, 2] > 0)
    return float(points[middle, 2].median()) if middle.any() else None


def _rounded(values: torch.Tensor) -> list[float]:
    """Numbers with the digits that float32 has, whatever unit of length they are in."""
    return [float(f"{value:.7g}") for value in values.tolist()]


def _jpeg(picture: torch.Tensor) -> bytes:
    """A picture [H, W, 3] in [0, 1], made smaller if it is large."""
    image = Image.fromarray((picture * 255).round().byte().cpu().numpy())
    image.thumbnail((POSTER_SIDE, POSTER_SIDE))
    stream = io.BytesIO()
    image.save(stream, "jpeg", quality=80)
    return stream.getvalue()
