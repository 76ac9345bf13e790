# SPDX-License-Identifier: Apache-2.0
"""The posed scene that nerfstudio reads.

<out>/images/NAME            undistorted photographs; images_2, images_4, images_8 at a half, a quarter, an eighth
<out>/transforms.json        pinhole cameras (OpenGL camera-to-world), split, name of the point cloud
<out>/sparse.ply             the reconstruction's points and colours, in the same world
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from nrfgs_ns.data.pictures import read_exif, read_picture
from nrfgs_ns.data.views import interior_test_images
from nrfgs_ns.files import write_whole
from nrfgs_prepare.pairs import Advance
from nrfgs_prepare.photos import make_empty
from nrfgs_prepare.structure import colmap

DOWNSCALES = (2, 4, 8)
"""Copies that nerfstudio looks for; it takes the largest with sides of at most 1600 pixels."""


def write_scene(distorted: Path, photos: Path, undistorted: Path, out: Path, advance: Advance) -> None:
    """Undistort the photographs of a COLMAP model, and write a scene from them, with the EXIF of `photos`."""
    make_empty(undistorted)
    colmap().undistort_images(undistorted, distorted, photos, output_type="COLMAP", jpeg_quality=97)
    model = colmap().Reconstruction(undistorted / "sparse")
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    for folder in ("images", *(f"images_{factor}" for factor in DOWNSCALES)):
        make_empty(out / folder)
    for image in images:
        picture = read_picture(undistorted / "images" / image.name)
        for factor in DOWNSCALES:
            size = max(picture.width // factor, 1), max(picture.height // factor, 1)  # as nerfstudio rounds its cameras
            picture.resize(size, Image.Resampling.LANCZOS).save(out / f"images_{factor}" / image.name, quality=95)
        os.replace(undistorted / "images" / image.name, out / "images" / image.name)
        advance(1)
    model.export_PLY(out / "sparse.ply")
    write_whole(out / "transforms.json", json.dumps(_transforms(model, images, photos), indent=1) + "\n")


def _transforms(model: Any, images: list[Any], photos: Path) -> dict[str, Any]:
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
                **({"exif": exif} if (exif := read_exif(photos / image.name)) else {}),
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
