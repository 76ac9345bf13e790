# SPDX-License-Identifier: Apache-2.0
"""Images in memory and their order in training: nerfstudio's datamanager, made to fail early and clearly, to run
without an accelerator, and to continue after an interruption."""

import hashlib
import json
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import psutil
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
    _undistort_image,
)
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from torch import Tensor

from nrfgs_ns.data.checks import DRAWN, some, warn
from nrfgs_ns.data.colmap_parser import checked
from nrfgs_ns.data.dataparser import NrfgsDataParser, NrfgsDataParserConfig
from nrfgs_ns.data.lenses import LENS, undistorted_cameras
from nrfgs_ns.data.pictures import cache_folder, in_parallel, read_mask, read_picture
from nrfgs_ns.data.views import different_views, nearest_depth, scene_unit
from nrfgs_ns.errors import InputError, refusing, require
from nrfgs_ns.files import whole

IMAGES = "image", "mask"
"""What a photograph has in files."""
WITH_POINTS = {"nerfstudio-data": NerfstudioDataParserConfig(load_3D_points=True)}
DataParsers = tyro.conf.OmitSubcommandPrefixes[
    tyro.extras.subcommand_type_from_defaults(all_dataparsers | WITH_POINTS, prefix_names=False)
]
"""nerfstudio's choice of parsers, of which `nerfstudio-data` reads points without being asked, as in splatfacto."""


class NrfgsInputDataset(InputDataset):
    """nerfstudio's dataset, with errors that name the file and the fix, and images of any mode as RGB or RGBA."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        for name in ("width", "height"):  # as images and masks are rounded; nerfstudio does it in float32
            sides = (getattr(dataparser_outputs.cameras, name).double() * scale_factor).int()
            if (sides < 1).any():
                option = f"--pipeline.datamanager.camera-res-scale-factor {scale_factor}"
                raise InputError(f"{option} leaves nothing of the images. Give a larger one.")
            setattr(self.cameras, name, sides.to(getattr(self.cameras, name)))
        kinds = {CameraType(kind) for kind in self.cameras.camera_type.flatten().tolist()}
        if other := some(sorted(kind.name for kind in kinds.difference(DRAWN))):
            place = self.image_filenames[0].parent
            raise InputError(f"{place}: cameras {other} cannot be trained on. Undistort the photographs to pinholes.")
        self.lenses = self.cameras
        """the cameras of the files; `cameras` are the pinholes of the images that `get_data` undistorts"""
        self.cameras = undistorted_cameras(self.lenses)
        # The datamanager removes entries from the list, which all datasets share.
        self.exclude_batch_keys_from_device = list(self.exclude_batch_keys_from_device)
        self.metadata["scene_unit"] = scene_unit(self.cameras.camera_to_worlds[:, :3, 3])
        self.metadata["different_views"] = different_views(self.cameras.camera_to_worlds)
        if (points := self.metadata.get("points3D_xyz")) is not None:
            self.metadata["nearest_depth"] = nearest_depth(points, self.cameras)
        self._sizes = torch.cat([self.lenses.width, self.lenses.height], dim=-1).tolist()
        self.downscale = self.metadata.get("downscale", 1)
        """size of the files / size of the cameras; nerfstudio's own parsers do not say it"""

    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        """A decoded image, uint8 [H, W, 3 or 4], of its camera's size."""
        path = self.image_filenames[image_idx]
        sampling = Image.Resampling.BILINEAR if self.downscale == 1 else Image.Resampling.LANCZOS
        return np.array(self._smaller(read_picture(path), image_idx, sampling, path))

    def _smaller(self, picture: Image.Image, index: int, sampling: Image.Resampling, path: Path) -> Image.Image:
        """A picture in full size, made as small as its camera by `downscale` and `scale_factor`."""
        size = [int(side * self.scale_factor) for side in picture.size] if self.downscale == 1 else self._sizes[index]
        if list(size) != self._sizes[index]:
            raise InputError(
                f"{path} is {size[0]} x {size[1]}, but its camera {' x '.join(map(str, self._sizes[index]))}. Use the "
                "image that the pose was computed from, or scale the intrinsics with it; masks are as large."
            )
        return picture if picture.size == tuple(size) else picture.resize(size, sampling)

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """The undistorted "image" [H, W, 3 or 4], "image_idx", and with masks "mask" bool [H, W, 1]; or InputError."""
        image = self.get_image_float32(image_idx) if image_type == "float32" else self.get_image_uint8(image_idx)
        data = {"image_idx": image_idx, "image": image}
        if (masks := self._dataparser_outputs.mask_filenames) is not None:
            path = masks[image_idx]
            mask = self._smaller(read_mask(path), image_idx, Image.Resampling.NEAREST, path)
            data["mask"] = torch.from_numpy(np.array(mask)).unsqueeze(-1).bool()
        if (distortion := self.lenses.distortion_params) is not None and distortion[image_idx].any():
            camera = self.lenses[image_idx].reshape(())
            K, parameters = camera.get_intrinsics_matrices().numpy(), camera.distortion_params.numpy()
            _, image, mask = _undistort_image(camera, parameters, data, data["image"].numpy(), K)
            data["image"] = torch.from_numpy(image)
            if mask is not None:
                data["mask"] = mask
        return data


@dataclass
class NrfgsDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's full-image datamanager, with images as uint8, in a quarter of the memory."""

    _target: type = field(default_factory=lambda: NrfgsDatamanager)
    dataparser: DataParsers = field(default_factory=NrfgsDataParserConfig)
    """specifies the dataparser config"""
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """The image type returned from manager, caching images in uint8 saves memory"""
    image_memory: float | None = None
    """gigabytes of host memory for decoded images; more go to files (docs/own-data.md). None: half of what is free"""


class NrfgsDatamanager(FullImageDatamanager[NrfgsInputDataset]):
    """nerfstudio's datamanager, except that it can load everything at once, run on a CPU, and restore its order."""

    config: NrfgsDatamanagerConfig

    def __init__(self, config: NrfgsDatamanagerConfig, *args: Any, **kwargs: Any):
        config.dataparser = checked(config.dataparser)
        scale, memory = config.camera_res_scale_factor, config.image_memory
        require(0 < scale <= 16, "--pipeline.datamanager.camera-res-scale-factor", scale, "more than 0, and up to 16")
        require(memory is None or memory >= 0, "--pipeline.datamanager.image-memory", memory, "0 or more gigabytes")
        self._views: dict[int, Cameras] = {}
        """training cameras by index, kept since moving one to a GPU takes as long as a step"""
        kinds: tuple[type[Exception], ...] = (OSError,)
        if not issubclass(config.dataparser._target, NrfgsDataParser):  # nerfstudio's raise others for a user's mistake
            kinds += LookupError, AttributeError, AssertionError, TypeError, ValueError
        fix = "Check the path in --data or config.yml, and what kind of data set it is."
        with refusing(f"{config.data or config.dataparser.data} cannot be read", fix, *kinds):
            super().__init__(config, *args, **kwargs)

    @property
    def evaluated_split(self) -> Literal["test", "training"]:
        """What evaluations are of: "training" where the data set keeps no image for testing."""
        trained, evaluated = (set(data.image_filenames) for data in (self.train_dataset, self.eval_dataset))
        return "training" if evaluated <= trained else "test"

    def load_all_images(self) -> None:
        """Decode all images. InputError if one cannot be used, or nothing is visible in any training image."""
        for dataset, images in ((self.train_dataset, self.cached_train), (self.eval_dataset, self.cached_eval)):
            pairs = zip(dataset.image_filenames, images, strict=True)
            if empty := [path.name for path, data in pairs if not _shows_anything(data)]:
                finding = f"{self.get_datapath()}: masks or transparency leave nothing of {some(empty)}"
                if dataset is self.train_dataset and len(empty) == len(images):
                    raise InputError(f"{finding}. Masks are 0 outside and 255 inside; opaque pixels have alpha 255.")
                warn(f"{finding}.")

    def next_train(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """The next `train_view` in turn."""
        return self.train_view(self._next_index())

    def train_view(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        """A training camera, [1] on the device with "cam_idx" in its metadata, and its photograph by `get_data`."""
        batch = self.cached_train[index]
        return self._view(index), batch | {"image": batch["image"].to(self.device)}

    def next_train_views(self, count: int, own: int) -> tuple[list[Cameras], dict[str, Any]]:
        """The next `count` training cameras in turn, [1] each, and the photograph of the one at position `own`."""
        indices = [self._next_index() for _ in range(count)]
        return [self._view(index) for index in indices], self.train_view(indices[own])[1]

    def _next_index(self) -> int:
        index = self.train_unseen_cameras.pop(0)
        if len(self.train_unseen_cameras) == 0:
            self.train_unseen_cameras = self.sample_train_cameras()
        return index

    def _view(self, index: int) -> Cameras:
        if index not in self._views:
            camera = self.train_dataset.cameras[index : index + 1].to(self.device)
            camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
            self._views[index] = camera
        return self._views[index]

    @cached_property
    def _storage(self) -> Literal["device", "memory", "files"]:
        """Where decoded images are: on the device if half of its free memory is enough, on the host, or in files."""
        each = 1 if self.config.cache_images_type == "uint8" else 4
        size = 0
        for dataset in (self.train_dataset, self.eval_dataset):
            channels = 3 * each + (dataset._dataparser_outputs.mask_filenames is not None)
            size += channels * int((dataset.cameras.width.long() * dataset.cameras.height).sum())
        if torch.device(self.device).type == "cuda" and self.config.cache_images == "gpu":
            if size <= torch.cuda.mem_get_info(self.device)[0] / 2:
                return "device"
        most = self.config.image_memory
        budget = psutil.virtual_memory().available / 2 if most is None else 1e9 * most
        if size <= budget:
            return "memory"
        takes = f"Decoded images take {size / 1e9:.1f} GB, and may take {budget / 1e9:.1f}"
        files = f"they are read from files in {cache_folder()}"
        CONSOLE.print(f"{takes} (--pipeline.datamanager.image-memory): {files}.", markup=False, soft_wrap=True)
        return "files"

    def _load_images(
        self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]
    ) -> list[dict[str, Tensor]]:
        """All images of a split, decoded and undistorted; `_storage` decides where, not `cache_images_device`."""
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        storage = self._storage
        kind = self.config.cache_images_type
        read = partial(from_cache, dataset) if storage == "files" else dataset.get_data

        def stored(data: dict[str, Any]) -> dict[str, Any]:
            if torch.device(self.device).type == "cpu" or storage == "files":
                return data
            move = Tensor.pin_memory if storage == "memory" else lambda values: values.to(self.device)
            return data | {name: move(data[name]) for name in IMAGES if name in data}

        sizes = [(dataset.downscale * width, dataset.downscale * height) for width, height in dataset._sizes]
        workers = self.config.max_thread_workers
        pictures = in_parallel(lambda index: read(index, kind), sizes, f"Reading {split} images", workers)
        return [stored(data) for data in pictures]

    def sampling_state(self) -> dict[str, Any]:
        """State of the order of training cameras, of plain numbers, lists and tuples."""
        return {"unseen_cameras": list(self.train_unseen_cameras), "generator": self.random_generator.getstate()}

    def load_sampling_state(self, state: dict[str, Any]) -> None:
        """Continue the order of cameras from `sampling_state()` of the same images (`training/identity.py`)."""
        self.train_unseen_cameras = list(state["unseen_cameras"])
        self.random_generator.setstate(state["generator"])


def _shows_anything(data: dict[str, Any]) -> bool:
    """Whether some pixel of a photograph is inside its mask and not transparent."""
    image = data["image"]
    return ("mask" not in data or bool(data["mask"].any())) and (image.shape[-1] < 4 or bool(image[..., 3].any()))


# Decoded and undistorted photographs; where memory is short, mapped files of their pixels, made anew where photograph,
# mask or camera has changed.


def from_cache(dataset: Any, index: int, image_type: str) -> dict[str, Any]:
    """`dataset.get_data` from a file that is mapped into memory, and made first if it is missing. Writing to the
    tensors does not change the file. InputError if there is no room for it."""
    path = _cache_file(dataset, index, image_type)
    try:
        content = torch.load(path, mmap=True, weights_only=True)
    except Exception:  # missing, or cut, as cleaners of caches leave them
        data = dataset.get_data(index, image_type)
        content = {name: data[name].contiguous() for name in IMAGES if name in data}
        fix = "Make room, set XDG_CACHE_HOME to another folder, or give more --pipeline.datamanager.image-memory."
        with refusing(f"{path} cannot be written", fix, OSError, RuntimeError), whole(path) as unfinished:
            torch.save(content, unfinished)  # raises RuntimeError where the disk is full
        content = torch.load(path, mmap=True, weights_only=True)
    return {"image_idx": index} | content


def _cache_file(dataset: Any, index: int, image_type: str) -> Path:
    """A photograph's file in the cache, named by a digest of all that its pixels depend on."""
    outputs, cameras = dataset._dataparser_outputs, dataset.lenses
    paths = [names[index] for names in (outputs.image_filenames, outputs.mask_filenames) if names is not None]
    files = [(str(path.resolve()), (stat := path.stat()).st_size, stat.st_mtime_ns) for path in paths]
    distortion = None if cameras.distortion_params is None else cameras.distortion_params[index].tolist()
    camera = [distortion, *(getattr(cameras, name)[index].item() for name in (*LENS, "camera_type"))]
    inputs = [files, camera, image_type, dataset.scale_factor, str(outputs.alpha_color)]
    name = hashlib.sha256(json.dumps(inputs).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return cache_folder() / f"{name}.pt"
