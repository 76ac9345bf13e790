# SPDX-License-Identifier: Apache-2.0
"""A trained neural residual field with shorter latents, without further training.

Latents z [D] that lie in a subspace are folded into the first layer (W, b), which is exact: with z = m + B y,

    W z + b = (W B) y + (W m + b).

The subspace is found by principal components in the metric G = W^T W, with the weights of both branches' first layers
below each other in W. A difference of latents then counts by how far it moves the hidden units, |W (z - z')|^2. With
eigenvectors R of the weighted covariance of G^(1/2) (z - m), strongest first,

    y = R^T G^(1/2) (z - m),    B = G^(-1/2) R.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig


class LatentBasis(NamedTuple):
    """Principal components of D numbers: z = mean + axes y, y = inverse (z - mean). float64."""

    mean: Tensor
    """m, the weighted mean of the latents. [D]"""
    axes: Tensor
    """B, one component in each column, the strongest first. [D, D]"""
    inverse: Tensor
    """of B. [D, D]"""


def latent_basis(field: Field, weight: Tensor) -> LatentBasis:
    """Principal components of the latents: for each r the first r of them predict W z with the least squared error.

    Args:
        field: N splats with an NRF head.
        weight: weight of each splat in the mean and the error, >= 0; equal if their sum is 0. [N]
    """
    latents = field.splats["latents"].detach().double()
    if not float(weight.sum()) > 0:
        weight = torch.ones_like(weight)
    weight = (weight / weight.sum()).double()[:, None]
    mean = (weight * latents).sum(dim=0)
    size = latents.shape[1]
    weights = field.head.state_dict()
    first_layers = torch.cat([weights[f"{branch}.0.weight"][:, :size].double() for branch in branches(weights)])
    values, vectors = torch.linalg.eigh(first_layers.T @ first_layers)
    # G can be singular. Directions that W ignores get a millionth of the largest root, so that G^(1/2) has an inverse.
    roots = values.clamp_min(max(float(values[-1]) * 1e-12, 1e-300)).sqrt()
    metric_root = (vectors * roots) @ vectors.T  # G^(1/2)
    inverse_root = (vectors / roots) @ vectors.T  # G^(-1/2)
    centred = (latents - mean) @ metric_root
    _, rotation = torch.linalg.eigh(centred.T @ (weight * centred))
    rotation = rotation.flip(1)  # R: eigh's order is ascending
    return LatentBasis(mean, inverse_root @ rotation, rotation.T @ metric_root)


def with_rank(field: Field, basis: LatentBasis, rank: int) -> Field:
    """The field with latents of `rank` numbers, 1..D: the first principal components, folded into the first layer."""
    reduced = (field.splats["latents"].detach().double() - basis.mean) @ basis.inverse[:rank].T
    return _folded(field, reduced, basis.axes[:, :rank], basis.mean)


def with_components(field: Field, columns: Tensor) -> Field:
    """The field with these columns of the latents alone, [R], R >= 1; the others count as 0 for every splat."""
    latents = field.splats["latents"].detach().double()
    axes = torch.eye(latents.shape[1]).to(latents)[:, columns]
    return _folded(field, latents[:, columns], axes, axes.new_zeros(len(axes)))


def _folded(field: Field, reduced: Tensor, axes: Tensor, mean: Tensor) -> Field:
    """The same field with latents y = reduced [N, R], where z = mean + axes y, for axes [D, R]; all float64."""
    weights = dict(field.head.state_dict())
    for branch in branches(weights):
        of_latents, others = weights[f"{branch}.0.weight"].double().tensor_split([len(axes)], dim=1)
        weights[f"{branch}.0.weight"] = torch.cat([of_latents @ axes, others], dim=1)
        weights[f"{branch}.0.bias"] = weights[f"{branch}.0.bias"].double() + of_latents @ mean
    smaller = Field(field.head, {**field.splats, "latents": reduced.to(field.splats["latents"].dtype)})
    return rebuilt(smaller, weights, latent_dim=axes.shape[1])


def branches(weights: Mapping[str, Tensor]) -> list[str]:
    """Names of the branches in a head's `state_dict`: "low" (or the only one), "high"."""
    return [name for name in ("low", "high") if f"{name}.0.weight" in weights]


def build(config: NrfConfig, weights: Mapping[str, Tensor], scene_unit: float) -> NeuralResidualField:
    """A head with given weights, by their names in its `state_dict`. The random generators are left alone."""
    with torch.random.fork_rng(devices=[]):
        head = config.setup(scene_unit)
    head.load_state_dict({name: value.float() for name, value in weights.items()})
    return head.to(next(iter(weights.values())).device).requires_grad_(False).eval()


def rebuilt(field: Field, weights: Mapping[str, Tensor], **options: Any) -> Field:
    """The field with other weights and options of its head."""
    return Field(build(replace(field.head.config, **options), weights, field.head.scene_unit), field.splats)
