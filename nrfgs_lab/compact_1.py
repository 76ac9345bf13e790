# SPDX-License-Identifier: Apache-2.0
"""A writer of compact files of version 1, which are still read: a field's header and streams.

docs/compact-format.md describes them.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.compact.encode import GROUPS, LARGEST_LOGIT, encode
from nrfgs_ns.compact.precision import Precision
from nrfgs_ns.compact.quantise import HALF_SQRT2, MOST_BITS, Grid, _others_of, morton
from nrfgs_ns.errors import InputError

Array = np.ndarray

FEWEST_BITS = 10
"""For a coordinate."""


def encode_1(
    field: Field, precision: Precision, render: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and streams of a compact file.

    Splats that are not finite are left out: nothing draws them.

    Args:
        field: the head, and its splats.
        precision: the steps.
        render: what else decides a picture, for the header.

    Raises:
        InputError: no splat is finite.
    """
    precision.validate()
    tables = {name: _array(value) for name, value in field.splats.items()}
    tables["colors"] = _array(base_colors(field.splats["features_dc"].detach().double()))
    diffuse = tables.get(DIFFUSE, np.zeros(len(tables["means"]))).astype(bool)
    finite = np.isfinite(np.concatenate([v.reshape(len(v), -1) for v in tables.values()], axis=1)).all(axis=1)
    finite &= np.abs(tables["quats"]).max(axis=1) > 0
    if not finite.any():
        raise InputError(f"None of the {len(finite)} splats is finite: there is nothing to write.")
    tables["opacities"] = tables["opacities"].clip(-LARGEST_LOGIT, LARGEST_LOGIT)
    tables["colors"][diffuse] = tables["colors"][diffuse].clip(min=0.0)  # as it is drawn

    grids = {"means": means_grid(tables["means"][finite], tables["scales"][finite], precision.means)}
    for name in ("scales", "opacities", "colors"):
        grids[name] = grid_with_step(tables[name][finite], getattr(precision, name))
    of_view = tables["latents"][finite & ~diffuse]
    spread = float(of_view.std(axis=0).max()) if len(of_view) > 1 else 0.0
    grids["latents"] = grid_with_step(of_view, precision.latents * spread if spread > 0 else 1.0)

    streams: dict[str, np.ndarray] = {}
    counts = {}
    for group in GROUPS:
        rows = np.flatnonzero(finite & (diffuse if group == DIFFUSE else ~diffuse))
        places = morton(grids["means"].codes(tables["means"][rows]))
        order = np.argsort(places, kind="stable")
        rows, places = rows[order], places[order]
        counts[group] = len(rows)
        streams[f"{group}.means"] = np.diff(places, prepend=np.uint64(0))
        largest, codes = smallest_three(tables["quats"][rows], precision.quats)
        streams[f"{group}.quats_largest"] = largest.astype(np.uint8)
        streams[f"{group}.quats"] = narrowest(codes.T)
        for name in ("scales", "opacities", "colors", *(["latents"] if group == "view" else [])):
            streams[f"{group}.{name}"] = narrowest(grids[name].codes(tables[name][rows]).T)
    header, of_now = encode(field, precision, render)
    streams |= {name: values for name, values in of_now.items() if name.startswith("head.")}
    header |= {
        "splats": counts,
        "grids": {name: grid.as_json() for name, grid in grids.items()},
        "quats_bits": precision.quats,
    }
    return header, streams


def means_grid(means: np.ndarray, log_scales: np.ndarray, precision: float) -> Grid:
    """2^b points along each side of the bounding box, b from 10 to 21, the fewest that are precise enough.

    Args:
        means: [N, 3].
        log_scales: [N, 3].
        precision: largest step, in standard deviations (the geometric mean of three) of the median splat.
    """
    wanted = precision * float(np.exp(np.median(log_scales.mean(axis=1))))
    for bits in range(FEWEST_BITS, MOST_BITS + 1):
        grid = grid_with_bits(means, bits)
        extent = means.max(axis=0) > means.min(axis=0)
        if (grid.step[extent] <= wanted).all():
            return grid
    return grid


def grid_with_bits(values: Array, bits: int) -> Grid:
    """The grid of 2^bits points from the smallest to the largest number of each column of [N, C]."""
    if len(values) == 0:
        return Grid(np.zeros(values.shape[1]), np.ones(values.shape[1]))
    low, high = values.min(axis=0), values.max(axis=0)
    step = (high - low) / (2**bits - 1)
    return Grid(low, np.where(step > 0, step, 1.0))


def grid_with_step(values: Array, step: float) -> Grid:
    """The grid with a given step from the smallest number of each column of [N, C]."""
    low = values.min(axis=0) if len(values) else np.zeros(values.shape[1])
    return Grid(low, np.full(values.shape[1], step))


def smallest_three(quats: Array, bits: int) -> tuple[Array, Array]:
    """Rotations [N, 4] (w, x, y, z), of any length but 0: which component is largest, and codes of the other three.

    The quaternion is made of unit length, and its sign such that the largest component is positive; the others lie
    within sqrt(1/2) of 0 and go on a grid of 2^bits points over that range.

    Returns:
        largest [N], 0..3, and codes [N, 3] of the others in order, int64.
    """
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    rows = np.arange(len(unit))
    unit = unit * np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = unit[_others_of(largest)].reshape(-1, 3)
    return largest, np.rint((others + HALF_SQRT2) / (2 * HALF_SQRT2) * (2**bits - 1)).astype(np.int64)


def narrowest(codes: Array) -> Array:
    """The same whole numbers >= 0 in the narrowest of uint8, uint16, uint32 and uint64."""
    top = int(codes.max()) if codes.size else 0
    for dtype in (np.uint8, np.uint16, np.uint32):
        if top <= np.iinfo(dtype).max:
            return codes.astype(dtype)
    return codes.astype(np.uint64)


def _array(value: Tensor) -> Array:
    value = value.detach().cpu()
    return value.numpy() if value.dtype == torch.bool else value.double().numpy()
