# SPDX-License-Identifier: Apache-2.0
"""A field as the arrays of a compact file. docs/compact-format.md describes each of them.

View-dependent and diffuse splats are kept apart: the second have no latents. Within each, splats are in Morton order of
their quantised means, and the means are the differences between successive Morton numbers. Every other table lies on a
uniform grid whose step is a choice of precision, not of bits: outliers then cost a few long codes, and not everyone's
precision.
"""

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.compact.precision import Precision
from nrfgs_ns.compact.quantise import (
    MOST_BITS,
    Grid,
    grid_with_bits,
    grid_with_step,
    morton,
    narrowest,
    smallest_three,
)
from nrfgs_ns.errors import InputError

FORMAT = "nrfgs-compact"
FEWEST_BITS = 10
"""For a coordinate."""
LARGEST_LOGIT = 10.0
"""Opacities' logits are cut off here: beyond, the opacity changes by less than 5e-5."""
LARGEST_HALF = 6e4
"""Weights beyond float16's range are kept in float32."""
GROUPS = ("view", DIFFUSE)


def encode(field: Field, precision: Precision, render: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
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
    for name, weight in field.head.state_dict().items():
        values = _array(weight)
        half = np.abs(values).max(initial=0.0) < LARGEST_HALF
        streams[f"head.{name}"] = values.astype(np.float16 if half else np.float32)

    config = asdict(field.head.config)
    config.pop("_target")
    header = {
        "format": FORMAT,
        "splats": counts,
        "head": {"name": field.head.name, "config": config, "scene_unit": field.head.scene_unit},
        "render": render,
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
    CONSOLE.print(
        f"[bold yellow]Some splats are so far from the others that {MOST_BITS} bits are too few for a coordinate: "
        f"means are rounded to {float(grid.step.max()):.3g} units instead of {wanted:.3g}.",
        soft_wrap=True,
    )
    return grid


def _array(value: Tensor) -> np.ndarray:
    value = value.detach().cpu()
    return value.numpy() if value.dtype == torch.bool else value.double().numpy()
