# SPDX-License-Identifier: Apache-2.0
"""The posed scene that nerfstudio reads.

<out>/images/NAME            undistorted photographs; images_2, images_4, images_8 at a half, a quarter, an eighth
<out>/transforms.json        pinhole cameras (OpenGL camera-to-world), split, name of the point cloud
<out>/sparse.ply             the reconstruction's points and colours, in the same world
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from nrfgs_ns.data.pictures import read_exif, read_picture
from nrfgs_ns.data.views import interior_test_images
from nrfgs_ns.files import write_whole
from nrfgs_prepare.pairs import Advance
from nrfgs_prepare.structure import colmap

DOWNSCALES = (2, 4, 8)
"""Copies that nerfstudio looks for; it takes the largest with sides of at most 1600 pixels."""


def write_scene(undistorted: Path, photos: Path, out: Path, advance: Advance) -> None:
    """Write a scene from the undistorted images/, which are linked, and sparse/ of a COLMAP model, with the EXIF of
    `photos` by the same names."""
    model = colmap().Reconstruction(undistorted / "sparse")
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    for folder in ("images", *(f"images_{factor}" for factor in DOWNSCALES)):
        shutil.rmtree(out / folder, ignore_errors=True)
        (out / folder).mkdir(parents=True)
    taken = {image.name: read_exif(photos / image.name) for image in images}
    for image in images:
        source = undistorted / "images" / image.name
        picture = read_picture(source)
        for factor in DOWNSCALES:
            size = max(picture.width // factor, 1), max(picture.height // factor, 1)  # as nerfstudio rounds its cameras
            picture.resize(size, Image.Resampling.LANCZOS).save(out / f"images_{factor}" / image.name, quality=95)
        try:
            os.link(source, out / "images" / image.name)
        except OSError:  # a file system without hard links
            shutil.copyfile(source, out / "images" / image.name)
        advance(1)
    points = list(model.points3D.values())
    xyz = np.array([point.xyz for point in points], dtype=np.float32).reshape(-1, 3)
    rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    write_ply(out / "sparse.ply", xyz, rgb)
    write_whole(out / "transforms.json", json.dumps(_transforms(model, images, taken), indent=1) + "\n")


def write_ply(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write a .ply of points [N, 3], stored as float32, with colours uint8 [N, 3]."""
    columns = np.rec.fromarrays([*xyz.astype("<f4").T, *rgb.astype("u1").T], names="x,y,z,red,green,blue")
    PlyData([PlyElement.describe(np.asarray(columns), "vertex")], byte_order="<").write(str(path))


def _transforms(model: Any, images: list[Any], taken: dict[str, dict[str, float | str]]) -> dict[str, Any]:
    """The content of transforms.json for images sorted by name; intrinsics that all share are at the top level."""
    cameras = [_intrinsics(model.cameras[image.camera_id]) for image in images]
    shared = cameras[0] if all(camera == cameras[0] for camera in cameras) else {}
    names = [f"images/{image.name}" for image in images]
    test = [names[index] for index in interior_test_images(len(names))]
    train = [name for name in names if name not in test]
    return {
        "camera_model": "OPENCV",
        **shared,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "ply_file_path": "sparse.ply",
        "train_filenames": train,
        "val_filenames": test,
        "test_filenames": test,
        "frames": [
            {
                "file_path": name,
                **({} if shared else camera),
                **({"exif": taken[image.name]} if taken[image.name] else {}),
                "transform_matrix": _camera_to_world(image).tolist(),
            }
            for name, camera, image in zip(names, cameras, images, strict=True)
        ],
    }


def _camera_to_world(image: Any) -> np.ndarray:
    """The pose [4, 4] of a registered image, y up and z backwards (OpenGL)."""
    return np.vstack([image.cam_from_world().inverse().matrix() * (1.0, -1.0, -1.0, 1.0), (0, 0, 0, 1)])


def _intrinsics(camera: Any) -> dict[str, Any]:
    """Intrinsics of a PINHOLE camera; COLMAP's and nerfstudio's first pixel has its centre at (0.5, 0.5)."""
    fl_x, fl_y, cx, cy = (float(value) for value in camera.params)
    return {"w": camera.width, "h": camera.height, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
