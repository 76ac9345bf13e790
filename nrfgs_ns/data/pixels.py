# SPDX-License-Identifier: Apache-2.0
"""Decoded and undistorted photographs; where memory is short, mapped files of their pixels, made anew where photograph,
mask or camera has changed."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

from nrfgs_ns.data.pictures import cache_folder
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole

LENS = ("fx", "fy", "cx", "cy", "width", "height")
"""Fields of a camera that undistortion changes."""
PAGE = 4096
"""Bytes."""


def undistorted(dataset: Any, index: int, image_type: str) -> dict[str, Any]:
    """Undistort a photograph; its camera in the data set becomes the pinhole that would have taken it.

    Returns:
        "image" [H, W, 3 or 4] of `image_type` (uint8 or float32), "image_idx", and with masks "mask" bool [H, W, 1].
    """
    data = dataset.get_data(index, image_type=image_type)
    camera = dataset.cameras[index].reshape(())
    if camera.distortion_params is None or not camera.distortion_params.any():
        return data
    intrinsics = camera.get_intrinsics_matrices().numpy()
    K, image, mask = _undistort_image(camera, camera.distortion_params.numpy(), data, data["image"].numpy(), intrinsics)
    data["image"] = torch.from_numpy(image)
    if mask is not None:
        data["mask"] = mask
    _set_lens(dataset.cameras, index, (K[0, 0], K[1, 1], K[0, 2], K[1, 2], image.shape[1], image.shape[0]))
    return data


def from_files(dataset: Any, index: int, image_type: str) -> dict[str, Any]:
    """The same from files, which are made if they are missing; InputError if there is no room for them."""
    folder = _folder(dataset, index, image_type)
    mapped = ("image",) if dataset._dataparser_outputs.mask_filenames is None else ("image", "mask")
    try:
        pixels, lens = _read(folder, mapped)
    except (OSError, ValueError, EOFError):  # missing, or cut, as cleaners of caches leave them
        data = undistorted(dataset, index, image_type)
        lens = np.array([getattr(dataset.cameras, name)[index].item() for name in LENS])
        try:
            for name, values in {**{name: data[name].numpy() for name in mapped}, "lens": lens}.items():
                with whole(folder / f"{name}.npy") as aside, aside.open("wb") as file:
                    np.save(file, values)
        except OSError as error:
            raise InputError(
                f"{folder} cannot be written ({error.strerror}). Make room there, set XDG_CACHE_HOME to another "
                "folder, or give more --pipeline.datamanager.image-memory."
            ) from error
        pixels, lens = _read(folder, mapped)
    _set_lens(dataset.cameras, index, lens.tolist())
    return {"image_idx": index, **pixels}


def _read(folder: Path, mapped: Sequence[str]) -> tuple[dict[str, torch.Tensor], np.ndarray]:
    """Pixels of mapped files, which writing to the tensors does not change, and `LENS`."""
    pixels = {name: torch.from_numpy(np.load(folder / f"{name}.npy", mmap_mode="c")) for name in mapped}
    return pixels, np.load(folder / "lens.npy")


def look_through(image: torch.Tensor) -> None:
    """Read one byte of each page of a mapped image, so that it is in memory."""
    image.view(torch.uint8).flatten()[::PAGE].sum()


def _folder(dataset: Any, index: int, image_type: str) -> Path:
    """Folder of a photograph's files, named by a digest of all that decides its pixels."""
    outputs, cameras = dataset._dataparser_outputs, dataset.cameras
    paths = [names[index] for names in (outputs.image_filenames, outputs.mask_filenames) if names is not None]
    files = [(str(path.resolve()), (stat := path.stat()).st_size, stat.st_mtime_ns) for path in paths]
    distortion = None if cameras.distortion_params is None else cameras.distortion_params[index].tolist()
    camera = [distortion, *(getattr(cameras, name)[index].item() for name in (*LENS, "camera_type"))]
    kept = [files, camera, image_type, dataset.scale_factor, str(outputs.alpha_color)]
    name = hashlib.sha256(json.dumps(kept).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return cache_folder() / name


def _set_lens(cameras: Cameras, index: int, lens: Sequence[float]) -> None:
    for name, value in zip(LENS, lens, strict=True):
        getattr(cameras, name)[index] = float(value)
