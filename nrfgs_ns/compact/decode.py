# SPDX-License-Identifier: Apache-2.0
"""A compact file as the tables of a model. `format.py`, `encode.py` and `entropy.py` describe the file."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nrfgs_ns.appearance.field import DIFFUSE
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact.encode import FORMAT, GROUPS
from nrfgs_ns.compact.format import LARGEST_RATIO, LONGEST_REASON, SMALL, read_container
from nrfgs_ns.compact.tables import COLUMNS, Grid, from_morton, splats_of
from nrfgs_ns.errors import InputError

MOST_BANDS = 16
"""Of a head: the sixteenth repeats every ten microradians."""
NUMBERS = 14
"""Numbers of a splat, except its latents."""
WIDTHS = dict(zip(COLUMNS, (1, 3, 3, 3), strict=True))
"""Columns of each table in the stream "splats"."""


class Decoded(NamedTuple):
    """Content of a compact file."""

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
        if header["format"] != FORMAT or header["head"]["name"] != "nrf":
            raise ValueError(f"it holds {header['format']!r} with a head named {header['head']['name']!r}")
        config, weights = _config(header["head"]["config"]), _weights(streams)
        _check(header, config, weights, sum(stream.nbytes for stream in streams.values()))
        return Decoded(config, weights, _splats(header, streams, config.latent_dim), header)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:LONGEST_REASON]
        raise InputError(
            f"{path} does not describe a field ({type(error).__name__}: {reason}). Export it again with nrfgs export "
            "compact."
        ) from error


def _config(options: dict[str, Any]) -> NrfConfig:
    usual = NrfConfig(opacity_bound=NrfConfig().bound)
    for name, value in options.items():
        kind = type(getattr(usual, name))
        right = type(value) is kind or (type(value), kind) == (int, float)
        if not right or kind is float and not math.isfinite(value):
            raise ValueError(f"the head's {name} is {ascii(value)}")
    config = NrfConfig(**options)
    if config.num_bands > MOST_BANDS:
        raise ValueError(f"the head has {config.num_bands} bands")
    config.validate()
    return config


def _check(header: dict[str, Any], config: NrfConfig, weights: dict[str, Tensor], unpacked: int) -> None:
    """Raise ValueError for sizes that the file does not have, and impossible grids."""
    unit = header["head"]["scene_unit"]
    if type(unit) not in (int, float) or not 0 < unit < math.inf:
        raise ValueError(f"the head's scene_unit is {ascii(unit)}")
    rows, inputs = weights["low.0.weight"].shape
    if config.latent_dim >= inputs or config.hidden_width > rows:  # before a head of that size is built
        raise ValueError(f"head.low.0.weight of shape {[rows, inputs]} for {config}")
    columns = {"means": 3, **WIDTHS, "latents": config.latent_dim}
    for name, count in columns.items():
        low, step = (np.asarray(header["grids"][name][part]) for part in ("low", "step"))
        right = low.shape == step.shape == (count,) and {low.dtype.kind, step.dtype.kind} <= {"i", "f"}
        if not right or not np.isfinite([low, step]).all() or not (step > 0).all():
            raise ValueError(f"the grid of {name} is not {count} numbers with positive steps")
    with torch.random.fork_rng(devices=[]):
        shapes = {name: value.shape for name, value in config.setup().state_dict().items()}
    if {name: value.shape for name, value in weights.items()} != shapes:
        raise ValueError("the head's weights do not have the shapes of its options")
    if not all(torch.isfinite(weight).all() for weight in weights.values()):
        raise ValueError("the head's weights are not finite")
    counts = [header["splats"][group] for group in GROUPS]
    if not all(isinstance(count, int) and count >= 0 for count in counts):
        raise ValueError(f"{counts} splats")
    if 4 * sum(counts) * (config.latent_dim + NUMBERS) > max(LARGEST_RATIO * unpacked, SMALL):
        raise ValueError(f"{sum(counts)} splats with latents of {config.latent_dim}, unpacked from {unpacked} bytes")


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
    """State dictionary of a model with the file's head, from a compact file; InputError as `decode`."""
    decoded = decode(path)
    splats = dict(decoded.splats)
    diffuse = splats.pop(DIFFUSE)
    # The rest is no part of a picture.
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
