# SPDX-License-Identifier: Apache-2.0
"""A small field, a way through a compact file, and files taken apart; splats with harmonics."""

import json
import subprocess
import zlib
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact.decode import Decoded, decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.format import CHECKSUM, MAGIC, PREAMBLE, VERSION, container, read_header, read_streams
from nrfgs_ns.model.harmonics_fit import PlainSplats

RENDER = {"rasterize_mode": "classic", "background": [0.0, 0.0, 0.0]}
"""How a file says that it is rendered."""


def write_container(path: Path, header: dict, streams: dict) -> int:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.write_bytes(container(header, streams))


def read_container(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    header, first = read_header(data)
    return header, read_streams(data, header["streams"], first)


def parts(data: bytes) -> tuple[dict, list[bytes]]:
    """The header of a file, and its streams as they are in it."""
    length = PREAMBLE.unpack_from(data)[2]
    header = json.loads(data[PREAMBLE.size : PREAMBLE.size + length])
    at = PREAMBLE.size + length + 4
    bodies = []
    for entry in header["streams"]:
        bodies.append(data[at : at + entry["bytes"]])
        at += entry["bytes"]
    return header, bodies


def joined(text: bytes, bodies: list[bytes]) -> bytes:
    """A file of a header's text and streams, whose own checksum and length hold."""
    total = PREAMBLE.size + len(text) + CHECKSUM.size + sum(map(len, bodies))
    start = PREAMBLE.pack(MAGIC, VERSION, len(text), total) + text
    return b"".join([start, CHECKSUM.pack(zlib.crc32(start)), *bodies])


def in_node(code: str, folder: Path, *words: str) -> Any:
    """What the page's reader and some code after it print in Node, as JSON."""
    script = (files("nrfgs_ns.export.web") / "compact.js").read_text(encoding="utf-8") + code
    (folder / "read.js").write_text(script, encoding="utf-8")
    words = ["node", "read.js", *words]
    return json.loads(subprocess.run(words, cwd=folder, capture_output=True, check=True, timeout=300).stdout)


def field(count: int = 60, latent_dim: int = 8, **options) -> Field:
    torch.manual_seed(3)
    options = {"latent_dim": latent_dim, "hidden_width": 16, "output_init": "default"} | options
    head = NrfConfig(**options).setup().requires_grad_(False)
    splats = {
        "means": torch.randn(count, 3) * torch.tensor([1.0, 5.0, 0.2]),
        "quats": torch.randn(count, 4) * 3,
        "scales": torch.randn(count, 3) - 4,
        "opacities": torch.randn(count, 1) * 4,
        "features_dc": torch.randn(count, 3),
        "latents": torch.randn(count, latent_dim) * torch.linspace(2.0, 0.1, latent_dim),
    }
    return Field(head, splats)


def through_a_file(one: Field, tmp_path: Path) -> Decoded:
    write_container(tmp_path / "f.nrf", *encode(one, RENDER))
    return decode(tmp_path / "f.nrf")


def plain_splats(count: int) -> PlainSplats:
    """Splats of a 3DGS file, at random about the origin."""
    torch.manual_seed(1)
    return PlainSplats(
        means=torch.randn(count, 3),
        quats=torch.nn.functional.normalize(torch.randn(count, 4), dim=-1),
        scales=torch.randn(count, 3) * 0.3 - 1.5,
        opacities=torch.randn(count, 1),
        features_dc=torch.randn(count, 3),
        features_rest=torch.randn(count, 15, 3) * 0.3,
    )
