# SPDX-License-Identifier: Apache-2.0
"""Compact files read back as the tables of a model. `format.py`, `encode.py` and `entropy.py` specify the file."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.reduce import build
from nrfgs_ns.compact.encode import FORMAT
from nrfgs_ns.compact.entropy import expect
from nrfgs_ns.compact.format import BROKEN, check_keys, read_header, read_streams
from nrfgs_ns.compact.tables import COLUMNS, Grid, from_morton, splats_of
from nrfgs_ns.errors import InputError

MOST_BANDS = 16
"""Most bands of a head: the sixteenth repeats every ten microradians."""
LONGEST_REASON = 200
"""Characters of a message that may quote the file."""
WIDTHS = dict(zip(COLUMNS, (1, 3, 3, 3), strict=True))
"""Columns of each table in the stream "splats"."""
TABLES = {"means": ("uint32",), "splats": ("int16", "int32"), "latents": ("int16", "int32")}
"""Coded tables, and the types of their numbers."""
LARGEST = 1e18
"""Largest number among the options, and largest unit of length; the smallest unit is one over it. Products of two must
fit into float32."""


class Decoded(NamedTuple):
    """Content of a compact file."""

    config: NrfConfig
    """of the head"""
    weights: dict[str, Tensor]
    """the head's, float32, by their names in its `state_dict`"""
    splats: dict[str, Tensor]
    """the table, float32"""
    header: dict[str, Any]


def decode(path: Path) -> Decoded:
    """Read a compact file; InputError if it breaks a rule of docs/compact-format.md."""
    try:
        expect(path.is_file(), "it is no file")
        header, first = read_header(data := path.read_bytes())
        check_keys(header, ("format", "splats", "head", "render", "grids", "streams"), "the header")
        check_keys(header["head"], ("name", "config", "scene_unit"), "the head")
        content, name = header["format"], header["head"]["name"]
        expect(content == FORMAT and name == "nrf", f"it holds {content!r} with a head named {name!r}")
        config = _config(header["head"])
        _check_render(header["render"])
        grids = _grids(header["grids"], config.latent_dim)
        streams = read_streams(data, header["streams"], first)
        _check_kinds(header["streams"])
        heads = {name: stream.astype(np.float32) for name, stream in streams.items() if name.startswith("head.")}
        weights = {name.removeprefix("head."): torch.from_numpy(stream) for name, stream in heads.items()}
        build(config, weights, header["head"]["scene_unit"])  # RuntimeError for weights of other names and shapes
        expect(all(weight.isfinite().all() for weight in weights.values()), "the head's weights are not finite")
        return Decoded(config, weights, _splats(header["splats"], grids, streams), header)
    except BROKEN as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:LONGEST_REASON]
        raise InputError(f"{path} cannot be read as a compact file ({reason}). Copy or export it again.") from error


def _is_number(value: Any, low: float, high: float) -> bool:
    return type(value) in (int, float) and low <= value <= high


def _config(head: dict[str, Any]) -> NrfConfig:
    usual = NrfConfig(opacity_bound=NrfConfig().bound)
    options = {}
    for name, value in head["config"].items():
        kind = type(getattr(usual, name))
        right = _is_number(value, -LARGEST, LARGEST) if kind is float else type(value) is kind
        expect(right, f"the head's {name} is {ascii(value)}")
        options[name] = kind(value)
    config = NrfConfig(**options)
    config.validate()
    expect(config.num_bands <= MOST_BANDS, f"the head has {config.num_bands} bands")
    unit = head["scene_unit"]
    expect(_is_number(unit, 1 / LARGEST, LARGEST), f"the head's scene_unit is {ascii(unit)}")
    return config


def _check_render(render: dict[str, Any]) -> None:
    check_keys(render, ("rasterize_mode", "background"), "render", optional=("near_plane",))
    mode, background, near = render["rasterize_mode"], render["background"], render.get("near_plane", 0)
    expect(mode in ("classic", "antialiased"), f"it is rendered by {ascii(mode)}")
    is_color = type(background) is list and len(background) == 3 and all(_is_number(c, 0, 1) for c in background)
    expect(is_color, f"its background is {ascii(background)}")
    expect(_is_number(near, 0, LARGEST), f"the near plane is {ascii(near)}")


def _check_kinds(entries: list[dict[str, Any]]) -> None:
    """Raise ValueError unless the streams are the three tables and weights, in codings and types that suit them."""
    kinds = {entry["name"]: (entry["coding"], entry["dtype"]) for entry in entries}
    tables = {name for name in kinds if not name.startswith("head.")}
    expect(tables == set(TABLES), f"its tables are {ascii(sorted(tables))} instead of {sorted(TABLES)}")
    for name, (coding, dtype) in kinds.items():
        right = coding == ("rans" if name in TABLES else "xz") and dtype in TABLES.get(name, ("float16", "float32"))
        expect(right, f"{name} is of {coding} and {dtype}")


def _grids(grids: dict[str, Any], latent_dim: int) -> dict[str, Grid]:
    counts = {"means": 3, **WIDTHS, "latents": latent_dim}
    check_keys(grids, tuple(counts), "grids")
    read = {}
    for name, count in counts.items():
        check_keys(grids[name], ("low", "step"), f"the grid of {name}")
        lists = [grids[name][part] for part in ("low", "step")]
        right = all(type(row) is list and len(row) == count and {*map(type, row)} <= {int, float} for row in lists)
        expect(right, f"the grid of {name} is not {count} numbers")
        read[name] = Grid(*np.array(lists, dtype=np.float64))
        expect((read[name].step > 0).all(), f"the grid of {name} has steps that are not positive")
    return read


def _splats(count: Any, grids: dict[str, Grid], streams: dict[str, np.ndarray]) -> dict[str, Tensor]:
    expect(type(count) is int and count > 0, f"{ascii(count)} splats")
    for name, columns in {"means": 2, "splats": sum(WIDTHS.values()), "latents": len(grids["latents"].step)}.items():
        shape = streams[name].shape
        expect(shape == (columns, count), f"{name} of shape {list(shape)} instead of {[columns, count]}")
    upper, lower = streams["means"].astype(np.uint64)
    expect(upper.max() < 2**31, "means beyond 63 bits")
    places = np.cumsum((upper << np.uint64(32)) | lower, dtype=np.uint64)
    codes = {"means": from_morton(places), "latents": streams["latents"].T}
    codes |= zip(WIDTHS, np.split(streams["splats"].T, np.cumsum([*WIDTHS.values()])[:-1], axis=1), strict=True)
    with np.errstate(over="ignore"):  # what overflows is refused below
        values = {name: torch.from_numpy(grids[name].values(table.astype(np.float64))) for name, table in codes.items()}
    values["latents"] = values["latents"].float()  # the largest table by far, and no rotations to work out
    splats = {name: value.float() for name, value in splats_of(values).items()}
    for name, value in splats.items():
        expect(torch.isfinite(value).all(), f"{name} beyond float32")
    return splats


def model_state(model, decoded: Decoded) -> dict[str, Any]:
    """State dictionary of a model with a file's head and splats; its other parts do not show in an image, and stay."""
    return {
        **{n: v for n, v in model.state_dict().items() if not n.startswith(("gauss_params.", "head."))},
        **{f"gauss_params.{name}": value for name, value in decoded.splats.items()},
        **{f"head.{name}": value for name, value in decoded.weights.items()},
        "_extra_state": {
            "head": decoded.header["head"]["name"],
            "densification": model.densification.name,
            "strategy": {},
            "near": float(decoded.header["render"].get("near_plane", 0)),  # 0: splatfacto's
        },
    }
