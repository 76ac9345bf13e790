# SPDX-License-Identifier: Apache-2.0
"""A faster start of nerfstudio's viewer, which decodes all photographs again, at full size, to show them 100 pixels
high, and whose viser searches its archive of icons for every button, and imports Pillow's 40 formats to write JPEG."""

import functools
import tarfile
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.viewer.viewer import Viewer
from PIL import Image
from torch import Tensor
from viser import _gui_api, _gui_handles, _icons, _scene_api

from nrfgs_ns.data.pictures import open_picture
from nrfgs_ns.threads import few_threads
from nrfgs_ns.viewer.server import wrap

SIDE = 100
"""Pixels of the shorter side as shown"""


@functools.cache
def open_sooner() -> None:
    _gui_api.svg_from_icon = _gui_handles.svg_from_icon = icon
    _scene_api.iio = SimpleNamespace(imwrite=_write)
    wrap("init_scene", _init_with_small_photographs)


def icon(name: str) -> str:
    """`viser._icons.svg_from_icon`, with the archive read once."""
    return _archived()[f"{name}.svg"].decode("utf-8")


@functools.cache
def _archived() -> dict[str, bytes]:
    with tarfile.open(_icons.ICONS_DIR / "tabler-icons.tar") as archive:
        return {member.name: archive.extractfile(member).read() for member in archive}


def _write(file: BinaryIO, image: np.ndarray, extension: str, **options: Any) -> None:
    """`imageio.v3.imwrite`, without its imports."""
    Image.fromarray(image).save(file, extension[1:], **options)


class SmallPhotographs:
    """The cameras and small photographs of a data set.

    Args:
        read: photographs in memory, with "image" [H, W, 3 or 4]; None: they are read from their files.
    """

    def __init__(self, dataset: InputDataset, read: Sequence[Mapping[str, Any]] | None):
        self.cameras = dataset.cameras
        self._paths = dataset.image_filenames
        self._read = read

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """A photograph as "image" [h, w, 3], float32 in [0, 1], with at least SIDE pixels to a side if it has them."""
        if self._read is not None:
            image = self._read[index]["image"]
        else:
            with open_picture(self._paths[index]) as picture:
                picture.draft("RGB", (SIDE, SIDE))  # JPEG decodes to an eighth, a quarter or a half directly
                image = torch.from_numpy(np.array(picture.convert("RGB")))
        stride = max(min(image.shape[:2]) // SIDE, 1)
        small = image[::stride, ::stride, :3].cpu()
        return {"image": small.float() / 255 if small.dtype == torch.uint8 else small}


def _init_with_small_photographs(init_scene: Callable[..., None], viewer: Viewer, train_dataset, *args, **options):
    """Open the scene with small photographs, and show it to browsers that were there before it."""
    read = vars(viewer.pipeline.datamanager).get("cached_train")
    with few_threads():
        init_scene(viewer, SmallPhotographs(train_dataset, read), *args, **options)
    for client in viewer.viser_server.get_clients().values():
        viewer.pipeline.model.viewer_panel.welcome(client)
