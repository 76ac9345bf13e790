# SPDX-License-Identifier: Apache-2.0
"""From the capture's world to the training world, and back.

In float32, numbers near ten million are a metre apart. Cameras far from the origin, such as georeferenced ones, are
therefore moved there in float64 first, and the way back is float64, too.
"""

import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs, transform_poses_to_original_space
from torch import Tensor

from nrfgs_ns.errors import InputError

FAR = 100.0
"""Distance of the cameras' mean from the origin, in their extents, above which they are moved in float64. Nearer ones
lose less than a hundredth of a pixel, and stay to the bit where nerfstudio puts them."""


class PlacedOutputs(DataparserOutputs):
    """nerfstudio's outputs, whose way back may be in float64."""

    def transform_poses_to_original_space(self, poses: Tensor, camera_convention="opencv") -> Tensor:
        way_back = self.dataparser_transform
        return transform_poses_to_original_space(
            poses.to(way_back.dtype), way_back, self.dataparser_scale, camera_convention=camera_convention
        )


def place(
    poses: np.ndarray, orientation: str, centering: str, auto_scale: bool, factor: float
) -> tuple[Tensor, Tensor, float]:
    """Orient, centre and scale camera-to-world poses, float64 [V, 4, 4], as nerfstudio does.

    Returns:
        The poses, float32 [V, 3, 4]; the transform [3, 4] before scaling, float64 if they were far from the origin and
        otherwise float32; and the scale.
    """
    if len(poses) == 1 and orientation == "vertical":  # needs two cameras
        orientation = "up"
    positions = poses[:, :3, 3]
    center, extent = positions.mean(axis=0), np.ptp(positions, axis=0).max()
    far = centering != "none" and np.abs(center).max() > FAR * extent > 0
    offset = rounded(center, extent) if far else np.zeros(3)
    near = poses.copy()
    near[:, :3, 3] -= offset
    placed, transform = camera_utils.auto_orient_and_center_poses(
        torch.from_numpy(near.astype(np.float32)), method=orientation, center_method=centering
    )
    if not torch.isfinite(transform).all():
        raise InputError(
            "The poses cannot be oriented, since their up directions cancel. Set the data parser's option "
            "--orientation-method none, or recompute the poses."
        )
    reach = float(torch.max(torch.abs(placed[:, :3, 3])))
    scale = (1.0 / reach if auto_scale and reach > 0 else 1.0) * factor
    placed[:, :3, 3] *= scale
    if far:
        transform = transform.double()
        transform[:, 3] -= transform[:, :3] @ torch.from_numpy(offset)
    return placed[:, :3, :4], transform, scale


def rounded(place: np.ndarray, extent: float) -> np.ndarray:
    """A place rounded to units, or to a power of two of the extent if that is less."""
    step = min(1.0, 2.0 ** np.floor(np.log2(extent)))
    return np.round(place / step) * step


def after(transform: Tensor, earlier: Tensor | None) -> Tensor:
    """The product [3, 4] of two transforms, in the first one's precision."""
    if earlier is None:
        return transform
    return transform @ torch.cat([earlier.to(transform), torch.tensor([[0, 0, 0, 1]]).to(transform)], 0)
