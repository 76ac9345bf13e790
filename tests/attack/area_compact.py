# SPDX-License-Identifier: Apache-2.0
"""Compact files: damaged, and made to mislead with checksums that hold."""

import json
import lzma
import zlib
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from attempt import DAMAGES, REPLACEMENTS, Case, damage, put, replace_in
from compact_fields import RENDER, field, joined, parts
from hypothesis import strategies as st

from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.format import MODEL, Table, _coded, container

AREA = "compact file"


@lru_cache
def written() -> bytes:
    return container(*encode(field(), dict(RENDER)))


def holding(name: str, content, hostile: bool = True) -> Case:
    """A file of bytes, which a function may make."""

    def build(folder: Path):
        (folder / "field.nrf").write_bytes(content() if callable(content) else content)
        return partial(decode, folder / "field.nrf")

    return Case(name, build, hostile)


def claiming(name: str, change, hostile: bool = True) -> Case:
    """A header, and perhaps streams, that `change(header, bodies)` has changed."""

    def content() -> bytes:
        header, bodies = parts(written())
        change(header, bodies)
        return joined(json.dumps(header).encode(), bodies)

    return holding(name, content, hostile)


@lru_cache
def zeros(size: int) -> bytes:
    """Zeros, packed to next to nothing."""
    packer = lzma.LZMACompressor(format=lzma.FORMAT_XZ, check=lzma.CHECK_NONE, preset=0)
    return b"".join([*(packer.compress(bytes(2**20)) for _ in range(size // 2**20)), packer.flush()])


def replaced(name: str, stream: str, count: int, body, **entry) -> Case:
    """A stream with another body, and a header that says so."""

    def change(header: dict, bodies: list[bytes]) -> None:
        content, index = body(), [one["name"] for one in header["streams"]].index(stream)
        one = header["streams"][index]
        shape = [count] if len(one["shape"]) == 1 else [one["shape"][0], count // one["shape"][0]]
        one.update({"shape": shape, "bytes": len(content), "crc32": zlib.crc32(content), **entry})
        bodies[index] = content
        header["splats"] = count

    return claiming(f"{stream}: {name}", change)


def coded(name: str, stream: str, shape: list[int], body) -> Case:
    """A coded table of another shape and with another body."""
    return replaced(name, stream, 60, body, shape=shape)


def table_of_zeros(columns: int, rows: int) -> bytes:
    return _coded(Table(np.zeros((columns, rows), dtype=np.int64)))[1]


def model(count: int, size: int | None = None, unpacked: int = 0) -> bytes:
    """The model of a coded table that claims `count` numbers in `size` bytes; None: the true size."""
    packed = zeros(unpacked)
    return MODEL.pack(count, len(packed) if size is None else size) + packed + bytes(400)


def grid(table: str, part: str, value) -> Case:
    def change(header, _) -> None:
        header["grids"][table][part] = [value] * len(header["grids"][table][part])

    return claiming(f"{part} of {table} {value}", change)


CLAIMS = {
    ("splats",): (-1, 0, 61, 2**63),
    ("streams", 0, "shape"): ([2**40], [2**62, 4], [0, 2**62], [1] * 100 + [60], [-60]),
    ("streams", 0, "bytes"): (-1, 0, 2**63),
    ("head", "config", "latent_dim"): (0, -1, 9, 10**9, 2**63),
    ("head", "config", "hidden_width"): (0, 17, 10**30),
    ("head", "config", "num_bands"): (0, 4, 10**9),
    ("head", "config", "_target"): ("os.system",),
}
"""Place in the header -> values that it cannot have. compact/test_two_readers.py has more."""
TEXTS = {"deep": b"[" * 200_000, "no JSON": b"{", "a list": b"[]", "5,000 digits": b'{"streams": ' + b"9" * 5000 + b"}"}
CASES = [
    replaced("bomb of bytes", "means", 2**28, lambda: zeros(2**28), dtype="uint8", coding="xz"),
    replaced("bomb of words", "latents", 2**25, lambda: zeros(2**28), dtype="uint64", coding="xz"),
    coded("many rows of zeros", "latents", [8, 10**6], lambda: table_of_zeros(8, 10**6)),
    coded("many columns of zeros", "latents", [1000, 2000], lambda: table_of_zeros(1000, 2000)),
    coded("more columns than rows", "splats", [10**6, 1], lambda: table_of_zeros(10, 60)),
    coded("a model of 4 GB", "splats", [10, 60], lambda: model(2**30, unpacked=2**28)),
    coded("a model of 16 MB", "splats", [10, 60], lambda: model(2**22, unpacked=2**24)),
    *(
        coded(f"a model of {count} numbers in {size} bytes", "splats", [10, 60], partial(model, count, size))
        for count, size in ((2**32 - 1, 10), (5, 2**32 - 1), (0, 0), (5, 3))
    ),
    coded("no body", "splats", [10, 60], lambda: b""),
    coded("a state too few", "means", [2, 60], lambda: table_of_zeros(2, 60)[:-4]),
    *(
        claiming(f"{place} {str(value)[:20]}", lambda header, _, p=place, v=value: put(header, p, v))
        for place, values in CLAIMS.items()
        for value in values
    ),
    claiming("streams of one name", lambda header, _: header["streams"][1].update(name=header["streams"][0]["name"])),
    claiming("no format", lambda header, _: header.pop("format")),
    claiming("no head", lambda header, _: header.pop("head")),
    claiming("a stream less", lambda header, _: header["streams"].pop()),
    *(grid(table, "step", value) for table in ("means", "latents") for value in (0.0, -1.0, float("nan"), 1e300, "x")),
    *(grid("scales", "low", value) for value in (float("nan"), 1e300, -1e39, [], None)),
    *(holding(f"header {name}", lambda c=c: joined(c, parts(written())[1])) for name, c in TEXTS.items()),
    holding("empty", b""),
    holding("a PNG", b"\x89PNG\r\n\x1a\n" + bytes(100)),
    *(
        holding(f"cut at {share}", lambda s=share: written()[: int(s * len(written()))])
        for share in (0.001, 0.01, 0.3, 0.999)
    ),
    Case("not there", lambda folder: partial(decode, folder / "field.nrf")),
    Case("a folder", lambda folder: partial(decode, folder)),
    Case("a device", lambda folder: partial(decode, Path("/dev/zero"))),
    Case("a name too long", lambda folder: partial(decode, folder / ("x" * 300))),
]


def inputs() -> st.SearchStrategy[Case]:
    """A file that is damaged, or whose header says something else and has the checksum for it."""

    def damaged(chosen) -> Case:
        return holding(f"bytes {chosen}"[:200], damage(written(), chosen), hostile=False)

    def misleading(chosen) -> Case:
        return claiming(f"header {chosen}"[:200], lambda header, _: replace_in(header, chosen), hostile=False)

    return DAMAGES.map(damaged) | REPLACEMENTS.map(misleading)
