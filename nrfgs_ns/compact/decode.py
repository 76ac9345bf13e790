# SPDX-License-Identifier: Apache-2.0
"""A compact file as the tables of a model. `format.py`, `encode.py` and `entropy.py` describe the file."""

import math
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nrfgs_ns.appearance.field import DIFFUSE
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact.encode import FORMAT, GROUPS
from nrfgs_ns.compact.format import LARGEST_RATIO, SMALL, read_container
from nrfgs_ns.compact.quantise import Grid, from_morton
from nrfgs_ns.compact.tables import COLUMNS, splats_of
from nrfgs_ns.errors import InputError

MOST_BANDS = 16
"""Of a head: the sixteenth repeats every ten microradians."""
NUMBERS = 14
"""Of a splat beside its latents."""
WIDTHS = dict(zip(COLUMNS, (1, 3, 3, 3), strict=True))
"""Columns of each table in the stream "splats"."""
LONGEST = 200
"""Characters of what a message quotes."""


class Decoded(NamedTuple):
    """What a compact file holds."""

    config: NrfConfig
    """of the head"""
    weights: dict[str, Tensor]
    """the head's, float32, by their names in its `state_dict`"""
    splats: dict[str, Tensor]
    """the table, float32, and "diffuse", bool [N]; latents of diffuse splats are 0"""
    header: dict[str, Any]


def decode(path: Path) -> Decoded:
    """Read a compact file; InputError if it cannot be read, is damaged, or describes no field."""
    header, streams = read_container(path)
    try:
        if header["format"] != FORMAT:
            raise ValueError(f"it holds {header['format']!r}")
        config, weights = _config(header["head"]), _weights(streams)
        _check(header, config, weights, sum(stream.nbytes for stream in streams.values()))
        return Decoded(config, weights, _splats(header, streams, config.latent_dim), header)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:LONGEST]
        raise InputError(
            f"{path} does not describe a field ({type(error).__name__}: {reason}). Export it again with nrfgs export "
            "compact."
        ) from error


def _config(head: dict[str, Any]) -> NrfConfig:
    if head["name"] != "nrf":
        raise ValueError(f"a head named {head['name']!r}")
    known = {field.name for field in fields(NrfConfig)} - {"_target"}
    if unknown := head["config"].keys() - known:
        raise ValueError(f"an unknown option {sorted(unknown)[0]!r} of the head")
    config = NrfConfig(**head["config"])
    usual = NrfConfig(opacity_bound=NrfConfig().bound)
    for name in known:
        value, default = getattr(config, name), getattr(usual, name)
        right = isinstance(value, (int, float) if isinstance(default, float) else type(default))
        right &= isinstance(value, bool) == isinstance(default, bool)
        if not right or isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"the head's {name} is {ascii(value)}")
    if config.num_bands > MOST_BANDS:
        raise ValueError(f"the head has {config.num_bands} bands")
    config.validate()
    return config


def _check(header: dict[str, Any], config: NrfConfig, weights: dict[str, Tensor], unpacked: int) -> None:
    """Raise ValueError for sizes that the file does not have, and impossible grids."""
    unit = header["head"]["scene_unit"]
    if isinstance(unit, bool) or not isinstance(unit, (int, float)) or not 0 < float(unit) < math.inf:
        raise ValueError(f"the head's scene_unit is {ascii(unit)}")
    rows, inputs = weights["low.0.weight"].shape
    if config.latent_dim >= inputs or config.hidden_width > rows:  # before a head of that size is built
        sizes = f"latents of {config.latent_dim} and {config.hidden_width} hidden units"
        raise ValueError(f"head.low.0.weight of shape {[rows, inputs]} with {sizes}")
    columns = {"means": 3, "turns": 3, "scales": 3, "opacities": 1, "colors": 3, "latents": config.latent_dim}
    for name, count in columns.items():
        low, step = (np.asarray(header["grids"][name][part]) for part in ("low", "step"))
        right = low.shape == step.shape == (count,) and {low.dtype.kind, step.dtype.kind} <= {"i", "f"}
        if not right or not np.isfinite([low, step]).all() or not (step > 0).all():
            raise ValueError(f"the grid of {name} is not {count} numbers with positive steps")
    with torch.random.fork_rng(devices=[]):  # whose numbers are not looked at
        shapes = {name: list(value.shape) for name, value in config.setup().state_dict().items()}
    for name in shapes.keys() | weights.keys():
        shape = list(weights[name].shape) if name in weights else "none"
        if shape != shapes.get(name):
            raise ValueError(f"head.{name} of shape {shape}, for a head that has {shapes.get(name, 'none')}")
        if not torch.isfinite(weights[name]).all():
            raise ValueError(f"head.{name} is not finite")
    counts = [header["splats"][group] for group in GROUPS]
    if not all(isinstance(count, int) and count >= 0 for count in counts):
        raise ValueError(f"{counts} splats")
    count = sum(counts)
    tables = 4 * count * (config.latent_dim + NUMBERS)
    if tables > max(LARGEST_RATIO * unpacked, SMALL):
        raise ValueError(f"{count} splats with latents of {config.latent_dim}, unpacked from {unpacked} bytes")


def _weights(streams: dict[str, np.ndarray]) -> dict[str, Tensor]:
    weights = {name.removeprefix("head."): value for name, value in streams.items() if name.startswith("head.")}
    return {name: torch.from_numpy(value.astype(np.float32)) for name, value in weights.items()}


def _splats(header: dict[str, Any], streams: dict[str, np.ndarray], rank: int) -> dict[str, Tensor]:
    count, of_view = sum(header["splats"][group] for group in GROUPS), header["splats"]["view"]
    shapes = {"means": (2, count), "splats": (1 + sum(WIDTHS.values()), count), "latents": (rank, of_view)}
    for name, shape in shapes.items():
        if streams[name].shape != shape or streams[name].dtype.kind not in "iu":
            raise ValueError(f"{name} of shape {list(streams[name].shape)} instead of {list(shape)}")
    upper, lower = streams["means"].astype(np.uint64)
    if upper.max(initial=0) >= 2**31:
        raise ValueError("means beyond 63 bits")
    places = np.cumsum((upper << np.uint64(32)) | lower, dtype=np.uint64)
    diffuse = streams["splats"][0] != 0
    if int((~diffuse).sum()) != of_view:
        raise ValueError(f"{int((~diffuse).sum())} view-dependent splats instead of {of_view}")
    codes = {"means": from_morton(places), "latents": streams["latents"].T}
    first = 1
    for name, width in WIDTHS.items():
        codes[name], first = streams["splats"][first : first + width].T, first + width
    grids = {name: Grid(np.array(grid["low"]), np.array(grid["step"])) for name, grid in header["grids"].items()}
    values = {name: torch.from_numpy(grids[name].values(table.astype(np.float64))) for name, table in codes.items()}
    values["latents"] = values["latents"].float()  # the largest table by far, and no turns to work out
    splats = splats_of(values, torch.from_numpy(diffuse))
    splats = {name: value if value.dtype == torch.bool else value.float() for name, value in splats.items()}
    for name, value in splats.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"{name} beyond float32")
    return splats


def model_state(model, path: Path) -> dict[str, Any]:
    """What `load_state_dict` of a model with the file's head takes, from a compact file; InputError as `decode`."""
    decoded = decode(path)
    splats = dict(decoded.splats)
    diffuse = splats.pop(DIFFUSE)
    # What is no part of a picture stays as the model has it.
    own = {n: v for n, v in model.state_dict().items() if not n.startswith(("gauss_params.", "head."))}
    return {
        **own,
        **{f"gauss_params.{name}": value for name, value in splats.items()},
        **{f"head.{name}": value for name, value in decoded.weights.items()},
        "_extra_state": {
            "head": decoded.header["head"]["name"],
            "densification": model.densification.name,
            "strategy": {DIFFUSE: diffuse} if diffuse.any() else {},
        },
    }
