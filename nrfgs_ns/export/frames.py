# SPDX-License-Identifier: Apache-2.0
"""Splats in another coordinate frame: means, rotations, scales, and harmonics, which turn with them."""

from dataclasses import dataclass

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from nrfgs_ns.appearance.sh import sh_bases
from nrfgs_ns.data.dataparser import rounded
from nrfgs_ns.model.harmonics_fit import PlainSplats


@dataclass(frozen=True)
class Similarity:
    """x -> scale rotation x + translation, in float64."""

    rotation: Tensor
    """[3, 3]"""
    scale: float
    """> 0"""
    translation: Tensor
    """[3]"""

    @property
    def inverse(self) -> "Similarity":
        if self is NOWHERE:
            return self
        return Similarity(self.rotation.T, 1.0 / self.scale, -self.rotation.T / self.scale @ self.translation)

    def places(self, points: Tensor) -> Tensor:
        """Images of points [N, 3], float64."""
        return self.scale * points.double() @ self.rotation.to(points.device).T + self.translation.to(points.device)

    def moved(self, splats: PlainSplats) -> PlainSplats:
        """The splats in the other frame; NOWHERE's are the same to the bit."""
        if self is NOWHERE:
            return splats
        quats = np.roll(splats.quats.double().cpu().numpy(), -1, axis=1)
        undrawn = ~(np.linalg.norm(quats, axis=1) > 0)  # SciPy refuses what is no rotation
        quats[undrawn] = 1.0
        turned = (Rotation.from_matrix(self.rotation.numpy()) * Rotation.from_quat(quats)).as_quat()
        turned[undrawn] = np.nan
        harmonics = _turned_harmonics(self.rotation.to(splats.means.device)).to(splats.features_rest)
        return splats._replace(
            means=self.places(splats.means).to(splats.means.dtype),
            quats=torch.from_numpy(np.roll(turned, 1, axis=1)).to(splats.quats),
            scales=splats.scales + torch.tensor(self.scale).log().item(),
            features_rest=torch.einsum("ab,nbc->nac", harmonics, splats.features_rest),
        )


NOWHERE = Similarity(torch.eye(3).double(), 1.0, torch.zeros(3).double())
"""The identity."""
Y_DOWN = Similarity(torch.tensor([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).double(), 1.0, torch.zeros(3).double())
"""From nerfstudio's world, whose z points up, to the world of 3DGS's viewers, whose y points down."""


def to_capture(outputs: DataparserOutputs) -> tuple[Similarity, np.ndarray]:
    """From the training's world to the original reconstruction's, before an `applied_transform`, less an origin.

    The origin, float64 [3], is a point amid the cameras, to be subtracted before rounding to float32; 0 where float32
    is enough.
    """
    transform = outputs.dataparser_transform
    scale = float(outputs.dataparser_scale)
    rotation = transform[:, :3].double().T
    back = -rotation @ transform[:, 3].double()
    origin = rounded(back.numpy(), 1 / scale) if transform.dtype == torch.float64 else np.zeros(3)
    return Similarity(rotation, 1.0 / scale, back - torch.from_numpy(origin)), origin


def _turned_harmonics(rotation: Tensor) -> Tensor:
    """The matrix that turns the 15 coefficients of degree 1 to 3, float64 [15, 15].

    A turned function f'(d) = f(R^T d) has coefficients k' with B(d) k' = B(R^T d) k for all d. No degree mixes with
    another: 64 directions determine the matrix, up to rounding.
    """
    generator = torch.Generator().manual_seed(0)
    directions = normalize(torch.randn(64, 3, dtype=torch.float64, generator=generator).to(rotation.device), dim=-1)
    bases, turned = sh_bases(3, directions), sh_bases(3, directions @ rotation)  # rows d^T R are (R^T d)^T
    return torch.linalg.lstsq(bases, turned).solution[1:, 1:]
