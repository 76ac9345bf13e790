# SPDX-License-Identifier: Apache-2.0
"""Nerfbaselines' cameras and data sets as nerfstudio's, in memory.

Nerfbaselines' poses are camera-to-world with y down and z forwards (OpenCV), in the data set's own world; nerfstudio's
have y up and z backwards, in a world that is turned upright, centred and scaled to the cameras.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from torch import Tensor

from nrfgs_ns.data.datamanager import NrfgsDatamanager, NrfgsDatamanagerConfig, NrfgsInputDataset
from nrfgs_ns.data.dataparser import MIN_POINTS, NrfgsDataParserConfig
from nrfgs_ns.data.world import place
from nrfgs_ns.errors import InputError

PINHOLE = 0
"""Nerfbaselines' number of the camera model without distortion."""


class World(NamedTuple):
    """From the data set's world to the one that is trained in: x -> scale (R x + t)."""

    transform: Tensor
    """[R | t], float64 [3, 4], R a rotation"""
    scale: float
    """> 0"""

    @classmethod
    def around(cls, poses: np.ndarray, options: NrfgsDataParserConfig) -> "World":
        """The world that nerfstudio's parser, with these options, makes of nerfbaselines' poses [V, 3 or 4, 4]."""
        rows = np.tile(np.eye(4), (len(poses), 1, 1))
        rows[:, :3] = _opengl(poses).numpy()
        _, transform, scale = place(
            rows, options.orientation_method, options.center_method, options.auto_scale_poses, options.scale_factor
        )
        return cls(transform.double(), scale)

    def points(self, xyz: Tensor) -> Tensor:
        """Points float64 [N, 3] of the data set's world in this one."""
        return self.scale * (xyz @ self.transform[:, :3].T + self.transform[:, 3])

    def cameras(self, given: Any) -> Cameras:
        """Nerfbaselines' cameras [V] as nerfstudio's; InputError if one is not a pinhole."""
        if (np.asarray(given.camera_models) != PINHOLE).any():
            raise InputError("A camera has distortion. Let nerfbaselines undistort: these methods take pinholes only.")
        poses = _opengl(given.poses)
        rotation = self.transform[:, :3] @ poses[:, :, :3]
        center = self.points(poses[:, :, 3])
        intrinsics = torch.from_numpy(np.array(given.intrinsics, dtype=np.float32))
        sizes = torch.from_numpy(np.array(given.image_sizes, dtype=np.int64))
        return Cameras(
            camera_to_worlds=torch.cat([rotation, center[..., None]], dim=-1).float(),
            **{name: intrinsics[:, i].contiguous() for i, name in enumerate(("fx", "fy", "cx", "cy"))},
            **{name: sizes[:, i].contiguous() for i, name in enumerate(("width", "height"))},
            camera_type=CameraType.PERSPECTIVE,
        )


def _opengl(poses: np.ndarray) -> Tensor:
    """Poses [V, 3 or 4, 4] with y up and z backwards, float64 [V, 3, 4]."""
    flip = np.array([1.0, -1.0, -1.0, 1.0])
    return torch.from_numpy(np.asarray(poses, dtype=np.float64)[:, :3] * flip)


def background_of(metadata: dict[str, Any]) -> str | None:
    """The model's background for a data set, None if it names none; InputError if it is neither black nor white."""
    color = metadata.get("background_color")
    if color is None:
        return None
    for name, value in (("black", 0), ("white", 255)):
        if (np.asarray(color) == value).all():
            return name
    raise InputError(f"The data set's background is {np.asarray(color).tolist()}; only black and white are known.")


def hold_in_memory(config: NrfgsDatamanagerConfig, dataset: dict[str, Any], world: World) -> None:
    """Let a datamanager's configuration hold nerfbaselines' training set in memory: its classes are replaced, because
    nerfstudio copies configurations.

    Raises:
        InputError: a camera is not a pinhole, or an option sizes the images.
    """
    if config.camera_res_scale_factor != 1.0:
        raise InputError("pipeline.datamanager.camera_res_scale_factor: nerfbaselines sizes the images itself.")
    cameras = world.cameras(dataset["cameras"])
    images, masks = dataset["images"], dataset.get("masks")
    metadata: dict[str, Tensor] = {}
    xyz, rgb = dataset.get("points3D_xyz"), dataset.get("points3D_rgb")
    if xyz is not None and len(xyz) >= MIN_POINTS:
        metadata["points3D_xyz"] = world.points(torch.from_numpy(np.array(xyz, dtype=np.float64))).float()
        colors = np.full((len(xyz), 3), 127, dtype=np.uint8) if rgb is None else rgb
        metadata["points3D_rgb"] = torch.from_numpy(_as_bytes(colors))
    outputs = DataparserOutputs([Path(path) for path in dataset["image_paths"]], cameras, metadata=metadata)

    class GivenParser(DataParser):
        """The same for all splits."""

        def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
            return outputs

    class GivenImages(NrfgsInputDataset):
        """The images in memory."""

        def get_numpy_image(self, image_idx: int) -> np.ndarray:
            width, height = self._sizes[image_idx]
            image = _as_bytes(np.asarray(images[image_idx])[:height, :width])
            return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)

        def get_data(self, image_idx: int, image_type="float32") -> dict[str, Any]:
            data = super().get_data(image_idx, image_type)
            if masks is not None:
                width, height = self._sizes[image_idx]
                mask = np.asarray(masks[image_idx])[:height, :width]
                data["mask"] = torch.from_numpy(_as_bytes(mask) > 127)[..., None]
            return data

    class GivenDatamanager(NrfgsDatamanager):
        """The training set alone: nerfbaselines evaluates."""

        dataset_type = GivenImages

        def create_eval_dataset(self):
            return self.train_dataset

        def load_all_images(self) -> tuple[int, int]:
            return len(self.cached_train), 0

    config._target, config.dataparser._target = GivenDatamanager, GivenParser
    config.image_memory = math.inf  # they are in memory


def _as_bytes(image: np.ndarray) -> np.ndarray:
    """Bytes as they are, truth values as 0 and 255, floats in [0, 1] times 255, rounded."""
    if image.dtype == np.uint8:
        return image
    if image.dtype == bool:
        return image.astype(np.uint8) * 255
    return np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
