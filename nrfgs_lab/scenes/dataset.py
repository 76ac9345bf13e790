# SPDX-License-Identifier: Apache-2.0
"""A scene as a nerfstudio data set: pictures, cameras, split and sparse points, reproducible to the byte.

<out>/transforms.json       cameras (OpenGL camera-to-world), split, name of the point cloud
<out>/images/view_000.png   display values (see `shading.tone_curve`) x 255, rounded
<out>/sparse.ply            points on visible surfaces, with their mean display colour over the training views
<out>/scene.json            version and config
"""

import contextlib
import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from .cameras import camera_rays, dome_cameras, project, render
from .config import SceneConfig
from .geometry import Array
from .scene import Scene, build_scene
from .shading import tone_curve

SCENE_VERSION = 2  # Raise it when the same config begins to give different pictures.
SEEN_TOLERANCE = 1e-3  # A view sees a surface point when its ray ends within this distance of it, world units.


def split_names(config: SceneConfig) -> tuple[list[str], list[str]]:
    """Paths of the training and the test images, relative to the data set; every `test_every`-th is a test image."""
    names = [f"images/view_{i:03d}.png" for i in range(config.views)]
    test = names[:: config.test_every]
    return [name for name in names if name not in set(test)], test


def write_scene(config: SceneConfig, out: Path, advance: Callable[[], object] = lambda: None) -> Path:
    """Render a scene and write it as a nerfstudio data set; reuse `out` when it already holds exactly that, and raise
    FileExistsError when it holds anything else. `advance` is called after each picture.

    The data set is written beside `out` and moved there when it is complete: an interrupted run leaves no half of one.
    """
    record = {"version": SCENE_VERSION, "config": asdict(config)}
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        with contextlib.suppress(OSError, ValueError):
            if json.loads((out / "scene.json").read_text(encoding="utf-8")) == record:
                return out
        raise FileExistsError(f"{out} exists and is not this procedural scene. Choose another, or delete this one.")

    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as workshop:
        staged = Path(workshop) / "scene"
        _write_files(build_scene(config), staged, advance)
        (staged / "scene.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        if out.is_dir():
            out.rmdir()  # it is empty; a folder cannot be moved onto another on every system
        staged.rename(out)
    return out


def sparse_points(scene: Scene, cameras: Array) -> tuple[Array, Array]:
    """Points [P, 3] on visible surfaces, as structure from motion would find them, and their colours [P, 3] in [0, 1).

    Positions are the ends of rays through uniformly random image positions of random views, so that every visible
    surface, floor and sky included, is covered in proportion to the pixels that it fills. Colours are display values,
    averaged over the views that see the point.

    Args:
        cameras: [V, 4, 4] camera-to-world matrices of the training views.
    """
    config = scene.config
    rng = np.random.default_rng([config.seed, 2])
    chosen = cameras[rng.integers(len(cameras), size=config.points)]
    pixels = rng.uniform((0.0, 0.0), (config.width, config.height), size=(config.points, 2))
    points, surfaces = scene.first_hit(*camera_rays(config, chosen, pixels))

    # The view that a point was found in sees it by construction: it starts the mean, so that no mean is empty.
    total = tone_curve(scene.outgoing_radiance(points, surfaces, chosen[:, :3, 3].astype(np.float32) - points))
    count = np.ones(len(points), dtype=np.float32)
    for camera in cameras:
        seen = np.flatnonzero(_sees(scene, camera, points))
        towards = camera[:3, 3].astype(np.float32) - points[seen]
        total[seen] += tone_curve(scene.outgoing_radiance(points[seen], surfaces[seen], towards))
        count[seen] += 1.0
    return points, total / count[:, None]


def _sees(scene: Scene, camera: Array, points: Array) -> Array:
    """Whether points [N, 3] are in a camera's picture and nothing stands before them, [N]."""
    config = scene.config
    pixels, depth = project(config, camera, points)
    inside = (depth > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels < (config.width, config.height)).all(axis=1)
    hits, _ = scene.first_hit(*camera_rays(config, camera, pixels))
    return inside & (np.linalg.norm(hits - points, axis=1) < SEEN_TOLERANCE)


def write_ply(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write a .ply of points [N, 3], stored as float32, with colours uint8 [N, 3]."""
    from plyfile import PlyData, PlyElement  # for work alone

    columns = np.rec.fromarrays([*xyz.astype("<f4").T, *rgb.astype("u1").T], names="x,y,z,red,green,blue")
    PlyData([PlyElement.describe(np.asarray(columns), "vertex")], byte_order="<").write(str(path))


def _write_files(scene: Scene, folder: Path, advance: Callable[[], object]) -> None:
    config = scene.config
    cameras = dome_cameras(config)
    train, test = split_names(config)
    names = sorted(train + test)
    (folder / "images").mkdir(parents=True)
    for name, camera in zip(names, cameras, strict=True):
        Image.fromarray(np.round(255.0 * render(scene, camera)).astype(np.uint8)).save(folder / name)
        advance()

    points, colours = sparse_points(scene, cameras[np.isin(names, train)])
    write_ply(folder / "sparse.ply", points, np.round(255.0 * colours).astype(np.uint8))
    lens = {"w": config.width, "h": config.height, **dict.fromkeys(("fl_x", "fl_y"), config.focal_length)}
    lens |= {"cx": 0.5 * config.width, "cy": 0.5 * config.height, **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)}
    split = {"train_filenames": train, "val_filenames": test, "test_filenames": test}
    places = zip(names, cameras, strict=True)
    frames = [{"file_path": name, "transform_matrix": camera.tolist()} for name, camera in places]
    transforms = {"camera_model": "OPENCV", **lens, "ply_file_path": "sparse.ply", **split, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(transforms, indent=1) + "\n", encoding="utf-8")
