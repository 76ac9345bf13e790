# SPDX-License-Identifier: Apache-2.0
"""Decoded and undistorted photographs, and files of their pixels where there is not enough memory.

Files are mapped: the system may drop what was read. They are made once, and anew where the photograph, its mask or its
camera has changed.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

from nrfgs_ns.data.pictures import cache_folder
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole, write_whole

LENS = ("fx", "fy", "cx", "cy", "width", "height")
"""Fields of a camera that undistortion changes."""
MAPPED = ("image", "mask")
PAGE = 4096
"""Bytes."""


def undistorted(dataset: Any, index: int, image_type: str) -> dict[str, Any]:
    """A photograph, undistorted; its camera in the data set becomes the pinhole that would have taken it.

    Returns:
        "image" [H, W, 3 or 4] of `image_type` (uint8 or float32), "image_idx", and "mask" bool [H, W, 1] if there are
        masks.
    """
    data = dataset.get_data(index, image_type=image_type)
    camera = dataset.cameras[index].reshape(())
    if camera.distortion_params is None or not camera.distortion_params.any():
        return data
    K, image, mask = _undistort_image(
        camera,
        camera.distortion_params.numpy(),
        data,
        data["image"].numpy(),
        camera.get_intrinsics_matrices().numpy(),
    )
    data["image"] = torch.from_numpy(image)
    if mask is not None:
        data["mask"] = mask
    _set_lens(dataset.cameras, index, (K[0, 0], K[1, 1], K[0, 2], K[1, 2], image.shape[1], image.shape[0]))
    return data


def from_files(dataset: Any, index: int, image_type: str) -> dict[str, Any]:
    """The same from files, which are made if they are not there.

    Raises:
        InputError: there is no room for them.
    """
    folder = _folder(dataset, index, image_type)
    about = _about(folder)
    if about is None:
        data = undistorted(dataset, index, image_type)
        try:
            _write(folder, data, [getattr(dataset.cameras, name)[index].item() for name in LENS])
        except OSError as error:
            raise InputError(
                f"{folder} cannot be written ({error.strerror}). Make room there, set XDG_CACHE_HOME to another "
                "folder, or give more --pipeline.datamanager.image-memory."
            ) from error
        about = _about(folder)
    _set_lens(dataset.cameras, index, about["lens"])
    return {"image_idx": index} | {name: _mapped(folder, name, about[name]) for name in MAPPED if name in about}


def look_through(image: torch.Tensor) -> None:
    """Read one byte of each page of a mapped image, so that it is in memory."""
    image.view(torch.uint8).flatten()[::PAGE].sum()


def _write(folder: Path, data: dict[str, Any], lens: list[float]) -> None:
    about: dict[str, Any] = {"lens": lens}
    for name in MAPPED:
        if name in data:
            values = data[name].contiguous()
            with whole(folder / f"{name}.bin") as aside:
                values.view(torch.uint8).numpy().tofile(aside)
            about[name] = [str(values.dtype).removeprefix("torch."), *values.shape]
    write_whole(folder / "about.json", json.dumps(about))  # last: with it the photograph is there


def _about(folder: Path) -> dict[str, Any] | None:
    """The description of a folder's files; None where one is missing or cut, as cleaners of caches leave them."""
    try:
        about = json.loads((folder / "about.json").read_text(encoding="utf-8"))
        sizes = {name: (folder / f"{name}.bin").stat().st_size for name in MAPPED if name in about}
        announced = {name: np.dtype(about[name][0]).itemsize * math.prod(about[name][1:]) for name in sizes}
        return about if sizes == announced else None
    except (OSError, ValueError):
        return None


def _mapped(folder: Path, name: str, form: list) -> torch.Tensor:
    """A mapped file; writing into the tensor leaves the file alone."""
    kind, *shape = form  # not torch.from_file, which takes only names that are UTF-8
    return torch.from_numpy(np.memmap(folder / f"{name}.bin", dtype=kind, mode="c", shape=tuple(shape)))


def _folder(dataset: Any, index: int, image_type: str) -> Path:
    """Folder of a photograph's files, named after everything that decides its pixels."""
    outputs = dataset._dataparser_outputs
    paths = [outputs.image_filenames[index]]
    if outputs.mask_filenames is not None:
        paths.append(outputs.mask_filenames[index])
    files = [(str(path.resolve()), (stat := path.stat()).st_size, stat.st_mtime_ns) for path in paths]
    cameras = dataset.cameras
    distortion = None if cameras.distortion_params is None else cameras.distortion_params[index].tolist()
    camera = [distortion, *(getattr(cameras, name)[index].item() for name in (*LENS, "camera_type"))]
    kept = [files, camera, image_type, dataset.scale_factor, str(dataset.mask_color), str(outputs.alpha_color)]
    name = hashlib.sha256(json.dumps(kept).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return cache_folder("pixels") / name


def _set_lens(cameras: Cameras, index: int, lens: Sequence[float]) -> None:
    for name, value in zip(LENS, lens, strict=True):
        getattr(cameras, name)[index] = float(value)
