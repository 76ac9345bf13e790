# SPDX-License-Identifier: Apache-2.0
"""A trained neural residual field with shorter latents or diffuse splats; nothing here trains.

Latents that lie in a subspace are folded into the first layer, which is exact: with z = m + B y,

    W z + b = (W B) y + (W m + b).
"""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.field import DIFFUSE, Field
from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig

Layers = tuple[Tensor, Tensor, Tensor, Tensor]
"""Weights of a branch: W1 [H, I], b1 [H], W2 [O, H], b2 [O]."""


def input_columns(config: NrfConfig, branch: str) -> dict[str, list[int]]:
    """Columns of the first layer's inputs, of the branch "low" (or the only one) or "high", by name.

    Names: latents, color, distance, opacity, direction, "band 0", "band 1", ...
    """
    sizes = {"latents": config.latent_dim, "color": 3}
    if config.use_distance:
        sizes["distance"] = 1
    if branch == "low":
        sizes |= {"opacity": 1, "direction": 3, "band 0": 6}
    if branch == "high" or not config.split_bands:
        sizes |= {f"band {k}": 6 for k in range(1, config.num_bands)}
    ends = list(itertools.accumulate(sizes.values()))
    return {name: list(range(end - size, end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}


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
        weight: of each splat, >= 0; equal if their sum is 0. Diffuse splats do not count. [N]
    """
    latents = field.splats["latents"].detach().double()
    if DIFFUSE in field.splats:
        weight = weight * ~field.splats[DIFFUSE]
    if not float(weight.sum()) > 0:
        weight = torch.ones_like(weight)
    weight = (weight / weight.sum()).double()[:, None]
    mean = (weight * latents).sum(dim=0)
    size = latents.shape[1]
    first_layers = torch.cat([layers(branch)[0][:, :size].double() for _, branch in branches_of(field.head)])
    gram = first_layers.T @ first_layers
    values, vectors = torch.linalg.eigh(gram)
    # Latents beside the layer's row space keep a millionth of the strongest one's metric: everything can be inverted.
    roots = values.clamp_min(max(float(values[-1]) * 1e-12, 1e-300)).sqrt()
    stretch, shrink = (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T
    centred = (latents - mean) @ stretch
    variances, turns = torch.linalg.eigh(centred.T @ (weight * centred))
    turns = turns.flip(1)
    return LatentBasis(mean, shrink @ turns, turns.T @ stretch, variances.flip(0).clamp_min(0.0))


def with_rank(field: Field, basis: LatentBasis, rank: int) -> Field:
    """Latents of `rank` numbers, 1..D: their first principal components, folded into the first layer."""
    size = field.head.config.latent_dim
    latents = field.splats["latents"]
    reduced = (latents.detach().double() - basis.mean) @ basis.inverse[:rank].T
    changed = []
    for _, branch in branches_of(field.head):
        w1, b1, w2, b2 = layers(branch)
        of_latents = w1[:, :size].double()
        folded = torch.cat([of_latents @ basis.axes[:, :rank], w1[:, size:].double()], dim=1)
        changed.append((folded, b1.double() + of_latents @ basis.mean, w2, b2))
    head = rebuilt(field.head, {"latent_dim": rank}, *pair(changed))
    return Field(head, {**field.splats, "latents": reduced.to(latents.dtype)})


def with_components(field: Field, columns: Tensor) -> Field:
    """Only these components of the latents, [R], at least one; the others are 0 for every splat."""
    size = field.head.config.latent_dim
    changed = []
    for _, branch in branches_of(field.head):
        w1, b1, w2, b2 = layers(branch)
        changed.append((torch.cat([w1[:, :size][:, columns], w1[:, size:]], dim=1), b1, w2, b2))
    head = rebuilt(field.head, {"latent_dim": len(columns)}, *pair(changed))
    return Field(head, {**field.splats, "latents": field.splats["latents"][:, columns]})


def with_diffuse(field: Field, diffuse: Tensor, features_dc: Tensor, opacities: Tensor) -> Field:
    """The splats `diffuse`, bool [N], without residual, and their appearance instead: [N, 3] and logits [N, 1]."""
    splats = {**field.splats, DIFFUSE: diffuse}
    for name, value in (("features_dc", features_dc), ("opacities", opacities)):
        splats[name] = torch.where(diffuse[:, None], value, field.splats[name].detach())
    return Field(field.head, splats)


def layers(branch: nn.Sequential) -> Layers:
    """A branch's weights, detached."""
    return tuple(weight.detach() for weight in (branch[0].weight, branch[0].bias, branch[2].weight, branch[2].bias))


def build(config: NrfConfig, weights: Mapping[str, Tensor], scene_unit: float) -> NeuralResidualField:
    """A head with given weights, by their names in its `state_dict`. The random generators are left alone."""
    with torch.random.fork_rng(devices=[]):
        head = config.setup()
    head.load_state_dict({name: value.float() for name, value in weights.items()})
    head.scene_unit = scene_unit
    return head.to(next(iter(weights.values())).device).requires_grad_(False).eval()


def rebuilt(old: NeuralResidualField, changes: dict, low: Layers, high: Layers | None) -> NeuralResidualField:
    """A head with other options and other weights of its branches."""
    weights = {}
    for name, branch in (("low", low), ("high", high)):
        if branch is not None:
            keys = (f"{name}.0.weight", f"{name}.0.bias", f"{name}.2.weight", f"{name}.2.bias")
            weights |= dict(zip(keys, branch, strict=True))
    return build(replace(old.config, **changes), weights, old.scene_unit)


def branches_of(head: NeuralResidualField) -> list[tuple[str, nn.Sequential]]:
    """The branches that a head has, by name."""
    return [(name, branch) for name, branch in (("low", head.low), ("high", head.high)) if branch is not None]


def pair(changed: list[Layers]) -> tuple[Layers, Layers | None]:
    """The low branch (or the only one), and the high one."""
    return changed[0], changed[1] if len(changed) > 1 else None
