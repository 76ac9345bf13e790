# SPDX-License-Identifier: Apache-2.0
"""A field as the header and the streams of a compact file; the container is `format.py`'s.

Keys of the header, beside "streams":

    format   "nrfgs-compact"
    splats   their number N
    head     "name" ("nrf"), "config" (the field's options, "latent_dim" the rank R), "scene_unit"
    render   "rasterize_mode", "background" (RGB), "near_plane" in world units
    grids    for "means", "turns", "scales", "opacities", "colors", "latents": "low" and "step", [columns]

An integer k in a column of a table stands for low + step k; low is 0 except in means. The streams:

    means        rans   [2, N]    upper and lower 32 bits of the differences of successive Morton numbers, the first
                                  counted from 0; not signed. Bit 3 k + a of a Morton number is bit k of the code of
                                  axis a, 21 bits each
    splats       rans   [10, N]   opacities (1), scales (3), colors (3), turns (3), as in `tables.py`
    latents      rans   [R, N]
    head.<name>  xz               the network's weights, float16; float32 where they are too large for it

head.low.0.weight [H, I], head.low.0.bias, head.low.2.weight, head.low.2.bias and the same of high are the layers of
`appearance/nrf.py`.

Splats are in Morton order of their rounded means, so that a number's neighbours in its table are neighbours in space.
A grid's step is a choice of precision, not of bits: an outlier costs a few long codes, and no other splat's precision.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.compact.format import Table
from nrfgs_ns.compact.tables import COLUMNS, MOST_BITS, Grid, morton, steps_of, tables_of
from nrfgs_ns.data.checks import warn
from nrfgs_ns.errors import InputError

FORMAT = "nrfgs-compact"
LARGEST_LOGIT = 10.0
"""Cut-off of opacity logits: beyond it, opacity changes by less than 5e-5."""
LARGEST_HALF = 6e4
"""Largest weight that is stored as float16."""
LARGEST_CODE = 2**30


def drawable(splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The finite splats with a rotation; InputError if there are none."""
    finite = torch.cat([value.detach().flatten(1) for value in splats.values()], dim=1).isfinite().all(dim=1)
    finite &= splats["quats"].detach().abs().amax(dim=1) > 0
    if not finite.any():
        raise InputError(f"None of the {len(finite)} splats is finite: there is nothing to write.")
    return {name: value[finite] for name, value in splats.items()}


def encode(
    field: Field, render: dict[str, Any], steps: Mapping[str, np.ndarray] | None = None, coarser: float = 1.0
) -> tuple[dict[str, Any], dict[str, np.ndarray | Table]]:
    """The header and streams of a compact file of the splats that are `drawable`.

    Args:
        render: the header's "render".
        steps: of a fine-tuned field's tables; None: `steps_of`.
        coarser: factor of all steps.
    """
    tables = tables_of(drawable(field.splats))
    tables["opacities"] = tables["opacities"].clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    steps = {name: coarser * step for name, step in (steps or steps_of(tables)).items()}
    needed = np.ptp(tables["means"].cpu().numpy(), axis=0) / (2**MOST_BITS - 1)
    if (needed > steps["means"]).any():
        warn(
            f"Some splats are so far from the others that {MOST_BITS} bits are too few for a coordinate: means are "
            f"rounded to {float(needed.max()):.3g} units instead of {float(steps['means'].min()):.3g}."
        )
    steps["means"] = np.maximum(steps["means"], needed).clip(min=np.finfo(np.float32).tiny)
    grids, codes = {}, {}
    for name, table in tables.items():
        values = table.cpu().numpy()
        low = values.min(axis=0) if name == "means" else np.zeros(values.shape[1])
        grids[name] = Grid(low, steps[name])
        codes[name] = grids[name].codes(values).clip(-LARGEST_CODE, LARGEST_CODE)

    places = morton(codes["means"])
    order = np.argsort(places, kind="stable")
    differences = np.diff(places[order], prepend=np.uint64(0))
    upper, lower = differences >> np.uint64(32), differences & np.uint64(0xFFFFFFFF)
    splats = np.concatenate([codes[name] for name in COLUMNS], axis=1)
    streams: dict[str, np.ndarray | Table] = {
        "means": Table(np.stack([upper, lower]), signed=False),
        "splats": Table(splats[order].T),
        "latents": Table(codes["latents"][order].T),
    }
    for name, weight in field.head.state_dict().items():
        values = weight.detach().cpu().double().numpy()
        half = np.abs(values).max(initial=0.0) < LARGEST_HALF
        streams[f"head.{name}"] = values.astype(np.float16 if half else np.float32)

    config = asdict(field.head.config) | {"opacity_bound": field.head.config.bound}
    config.pop("_target")
    header = {
        "format": FORMAT,
        "splats": len(order),
        "head": {"name": field.head.name, "config": config, "scene_unit": field.head.scene_unit},
        "render": render,
        "grids": {name: {"low": grid.low.tolist(), "step": grid.step.tolist()} for name, grid in grids.items()},
    }
    return header, streams
