# SPDX-License-Identifier: Apache-2.0
"""A trained neural residual field with shorter latents; nothing here trains.

Latents that lie in a subspace are folded into the first layer, which is exact: with z = m + B y,

    W z + b = (W B) y + (W m + b).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig


class LatentBasis(NamedTuple):
    """Principal components: z = mean + axes y, y = inverse (z - mean). float64."""

    mean: Tensor
    """[D]"""
    axes: Tensor
    """B, one component in each column, the strongest first. [D, D]"""
    inverse: Tensor
    """[D, D]"""
    variances: Tensor
    """of y, weighted, descending. [D]"""


def latent_basis(field: Field, weight: Tensor) -> LatentBasis:
    """Principal components of the latents, in the metric of the first layer's outputs.

    A direction of the latents counts by how far it moves the hidden units, |W (z - z')|^2 over both branches: the first
    r components predict W z with the least squared error, weighted, for each r.

    Args:
        weight: of each splat, >= 0; equal if their sum is 0. [N]
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
    # Latents beside the layer's row space keep a millionth of the strongest one's metric: everything can be inverted.
    roots = values.clamp_min(max(float(values[-1]) * 1e-12, 1e-300)).sqrt()
    stretch, shrink = (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T
    centred = (latents - mean) @ stretch
    variances, turns = torch.linalg.eigh(centred.T @ (weight * centred))
    turns = turns.flip(1)
    return LatentBasis(mean, shrink @ turns, turns.T @ stretch, variances.flip(0).clamp_min(0.0))


def with_rank(field: Field, basis: LatentBasis, rank: int) -> Field:
    """Latents of `rank` numbers, 1..D: their first principal components, folded into the first layer."""
    reduced = (field.splats["latents"].detach().double() - basis.mean) @ basis.inverse[:rank].T
    return _folded(field, reduced, basis.axes[:, :rank], basis.mean)


def with_components(field: Field, columns: Tensor) -> Field:
    """Only these components of the latents, [R], at least one; the others are 0 for every splat."""
    latents = field.splats["latents"].detach().double()
    axes = torch.eye(latents.shape[1]).to(latents)[:, columns]
    return _folded(field, latents[:, columns], axes, axes.new_zeros(len(axes)))


def _folded(field: Field, reduced: Tensor, axes: Tensor, mean: Tensor) -> Field:
    """The same field of the latents y [N, R] with z = mean + axes y, all float64."""
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
