# SPDX-License-Identifier: Apache-2.0
"""Python's reader and the page's refuse the same files, and read the same numbers in the others.

A small file is changed in its header, its streams and its bytes, one place at a time, with lengths and checksums that
hold again. docs/compact-format.md has the rules.
"""

import base64
import json
import lzma
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path

import compact_fields
import numpy as np
import pytest
import torch
from compact_fields import RENDER, field, in_node
from torch.testing import assert_close

from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact import format
from nrfgs_ns.compact.decode import Decoded, decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.entropy import decode_table, encode_table
from nrfgs_ns.compact.format import MODEL, PREAMBLE, Table, _pack, _unpack, container
from nrfgs_ns.errors import InputError
from nrfgs_ns.trained.loading import load_file

pytestmark = pytest.mark.usefixtures("no_cuda")

NUMBERS = [0, -1, 1, 1025, 2**31, 2**63, 10**400, 0.5, 8.0, 1e-320, 1e39, 1e308, float("nan")]
OTHERS = [None, True, False, "", "8", "logit", "rans", "uint32", [], {}, [[1.0]] * 3, [1, 0.5, 1e300]]
VALUES = [*NUMBERS, *OTHERS, "__proto__", {"length": 3}, "\ud800"]
COUNT = 20
"""Splats of the file that is damaged. Python's reader takes milliseconds for each."""
BYTES = (0x01, 0x80)
"""What a byte is changed by (exclusive or)."""


@pytest.fixture(autouse=True)
def equal_tables_are_coded_once(monkeypatch):
    """A file differs from the others in one place; most of its tables are theirs, and coding takes most of the time."""

    @lru_cache(None, typed=True)
    def encoded_once(numbers: bytes, dtype: str, shape: tuple, signed: bool):
        return encode_table(np.frombuffer(numbers, dtype).reshape(shape), signed)

    @lru_cache(None, typed=True)
    def decoded_once(model: bytes, *rest):
        return decode_table(np.frombuffer(model, "<i4"), *rest)

    def encode(table, signed=True):
        return encoded_once(table.tobytes(), table.dtype.str, table.shape, signed)

    monkeypatch.setattr(format, "encode_table", encode)
    monkeypatch.setattr(format, "decode_table", lambda model, *rest: decoded_once(model.astype("<i4").tobytes(), *rest))


@cache
def written(count: int = COUNT, **options) -> bytes:
    return container(*encode(field(count, **options), dict(RENDER)))


def parts() -> tuple[dict, list[bytes]]:
    """A new copy of the file's header and of its streams' bytes."""
    return compact_fields.parts(written())


def joined(header: dict | bytes, bodies: list[bytes], sizes: bool = True) -> bytes:
    """A file whose lengths and checksums hold; `sizes` False: its header's own claims about the streams' bytes stay."""
    if sizes and isinstance(header, dict):
        for entry, body in zip(header["streams"], bodies, strict=True):
            entry |= {"bytes": len(body), "crc32": zlib.crc32(body)}
    return compact_fields.joined(header if isinstance(header, bytes) else json.dumps(header).encode(), bodies)


def places(tree, at: tuple = ()) -> Iterator[tuple]:
    """The paths to the nodes of a header; of a list, only to the first, and to the last if it is a stream."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        if key == 0 or not isinstance(tree, list) or isinstance(value, dict) and key == len(tree) - 1:
            yield (*at, key)
            yield from places(value, (*at, key))


def node_at(tree, place: tuple):
    for key in place:
        tree = tree[key]
    return tree


def headers() -> Iterator[tuple[str, bytes]]:
    """Each value of the header replaced, removed, and joined by another key."""
    seen = list(places(parts()[0]))
    for place in seen:
        for value in VALUES:
            header, bodies = parts()
            node_at(header, place[:-1])[place[-1]] = deepcopy(value)
            yield f"{place} = {value!r:.40}", joined(header, bodies, sizes=False)
        header, bodies = parts()
        node_at(header, place[:-1]).pop(place[-1])
        yield f"without {place}", joined(header, bodies, sizes=False)
    for place in [(), *(place for place in seen if place[-1] in ("splats", "head", "config", "render", "means", 0))]:
        for key in ("x", "__proto__", "bound", "_target"):
            header, bodies = parts()
            if isinstance(node := node_at(header, place), dict):
                node[key] = 1
                yield f"{key} in {place}", joined(header, bodies, sizes=False)


def texts() -> Iterator[tuple[str, bytes]]:
    """Headers that are JSON for some readers, or for none."""
    header, bodies = parts()
    text = json.dumps(header)
    unit = f'"scene_unit": {json.dumps(header["head"]["scene_unit"])}'
    assert unit in text
    for number in ("NaN", "Infinity", "1.", ".5", "01", "+1", "0x1", "1e400", "9" * 5000, "-0", "1E0", "1e-400", "1_0"):
        yield f"a unit of {number[:9]}", joined(text.replace(unit, f'"scene_unit": {number}').encode(), bodies)
    for name, other in {
        "nothing": b"",
        "no JSON": b"{",
        "null": b"null",
        "a list": b"[]",
        "deep": b"[" * 100_000 + b"]" * 100_000,
        "a mark of the byte order": b"\xef\xbb\xbf" + text.encode(),
        "UTF-16": text.encode("utf-16-le"),
        "a byte that is no UTF-8": text.encode().replace(b"nrfgs", b"nrf\xffs"),
        "half a pair": text.encode().replace(b"nrfgs", b"nrf\xed\xa0\x80s"),
        "a key twice": text.replace(unit, f'"scene_unit": 0, {unit}').encode(),
        "the other twice": text.replace(unit, f'{unit}, "scene_unit": 0').encode(),
        "a comment": text.encode() + b"// x",
        "a space": text.encode() + b" \n",
        "a zero": text.encode() + b"\0",
        "a comma": text.encode()[:-1] + b",}",
        "a line in a string": text.encode().replace(b'"nrf"', b'"n\nrf"'),
        "an escape": text.encode().replace(b'"nrf"', b'"\\u006erf"'),
    }.items():
        yield f"text: {name}", joined(other, bodies)


def containers() -> Iterator[tuple[str, bytes]]:
    """Bytes before the streams changed, and files cut and continued."""
    data = written()
    for at in [*range(PREAMBLE.size), *range(PREAMBLE.size, len(data), len(data) // 40)]:
        yield f"byte {at}", data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :]
        yield f"cut at {at}", data[:at]
    yield "a byte more", data + b"\0"
    yield "nothing", b""
    header, bodies = parts()
    yield "a byte after the streams", joined(header, [*bodies[:-1], bodies[-1] + b"\0"], sizes=False)
    for name, change in {
        "in another order": lambda h, b: (h["streams"].reverse(), b.reverse()),
        "a stream twice": lambda h, b: (h["streams"].append(dict(h["streams"][0])), b.append(b[0])),
        "of another name": lambda h, b: (h["streams"].append({**h["streams"][0], "name": "x"}), b.append(b[0])),
        "a weight": lambda h, b: (h["streams"].append({**h["streams"][-1], "name": "head.x"}), b.append(b[-1])),
        "a stream less": lambda h, b: (h["streams"].pop(), b.pop()),
    }.items():
        header, bodies = parts()
        change(header, bodies)
        yield name, joined(header, bodies)


def with_body(name: str, change: Callable[[bytes], bytes], **entry) -> bytes:
    header, bodies = parts()
    index = next(i for i, one in enumerate(header["streams"]) if one["name"] == name)
    bodies[index] = change(bodies[index])
    header["streams"][index] |= entry
    return joined(header, bodies)


def flipped(at: int, by: int) -> Callable[[bytes], bytes]:
    return lambda body: body[:at] + bytes([body[at] ^ by]) + body[at + 1 :]


def xz_header(at: int, value: int) -> Callable[[bytes], bytes]:
    """A byte of the block's header, and the header's checksum for it."""

    def change(body: bytes) -> bytes:
        header = bytearray(body[12:20])
        header[at] = value
        return body[:12] + bytes(header) + struct.pack("<I", zlib.crc32(header)) + body[24:]

    return change


def packed(raw: bytes, **options) -> bytes:
    return lzma.compress(raw, **{"format": lzma.FORMAT_XZ, "check": lzma.CHECK_NONE} | options)


def xz_streams() -> Iterator[tuple[str, bytes]]:
    """Bytes of packed weights changed: everywhere in the frame, here and there inside."""
    name = "head.low.2.weight"
    header, bodies = parts()
    index = [entry["name"] for entry in header["streams"]].index(name)
    size, raw = len(bodies[index]), lzma.decompress(bodies[index])
    for at in [*range(32), *range(32, size - 32, 5), *range(size - 32, size)]:
        for by in BYTES:
            yield f"xz byte {at} ^ {by}", with_body(name, flipped(at, by))
    for at, values in ((0, (1, 3)), (1, (1, 0x40, 0x80)), (2, (3, 4)), (3, (0, 2)), (4, range(0, 44, 3)), (5, (1,))):
        for value in values:
            yield f"xz header {at} = {value}", with_body(name, xz_header(at, value))
    for at in (0, 11, 12, 24, 25, size - 12, size - 1):
        yield f"xz cut at {at}", with_body(name, lambda body, at=at: body[:at])
    for kind, body in {
        "no stream": b"",
        "padding": bodies[index] + bytes(4),
        "two streams": packed(raw[:8]) + packed(raw[8:]),
        "another filter first": packed(raw, filters=[{"id": lzma.FILTER_DELTA}, {"id": lzma.FILTER_LZMA2}]),
        "a checksum": packed(raw, check=lzma.CHECK_CRC32),
        "less": packed(raw[:-1]),
        "more": packed(raw + b"\0"),
        "lzma": lzma.compress(raw, format=lzma.FORMAT_ALONE),
        "other properties": packed(raw, filters=[{"id": lzma.FILTER_LZMA2, "lc": 1, "lp": 2, "pb": 3}]),
        "a bomb": packed(bytes(2**22)),
    }.items():
        yield f"xz of {kind}", with_body(name, lambda _, body=body: body)
    yield "a bomb that says so", with_body(name, lambda _: packed(bytes(2**22)), shape=[2**27])


def rans_streams() -> Iterator[tuple[str, bytes]]:
    """Models and words of coded tables changed."""
    for name in ("means", "splats", "latents"):
        header, bodies = parts()
        body = bodies[[entry["name"] for entry in header["streams"]].index(name)]
        count, size = MODEL.unpack_from(body)
        model = _unpack({"shape": [count], "dtype": "int32"}, body[MODEL.size : MODEL.size + size])
        words = MODEL.size + size
        for at in [*range(8), *range(8, count, max(count // 12, 1)), count - 1]:
            for value in (-1, 0, 16, 140, 2**14, 2**31 - 1, -(2**31)):
                other = model.copy()
                other[at] = value
                new = _pack(other)
                changed = MODEL.pack(count, len(new)) + new + body[words:]
                yield f"{name}: model {at} = {value}", with_body(name, lambda _, c=changed: c)
        for at in [*range(8), *range(8, words, 6), *range(words, len(body), max((len(body) - words) // 30, 1))]:
            for by in BYTES:
                yield f"{name}: byte {at} ^ {by}", with_body(name, flipped(at, by))
        for at in (0, 1, 4, 7, 8, words - 1, words, words + 3, words + 4, len(body) - 2, len(body) - 1):
            yield f"{name}: cut at {at}", with_body(name, lambda body, at=at: body[:at])
        for more in (b"\0", b"\0\0", bytes(100)):
            yield f"{name}: {len(more)} bytes more", with_body(name, lambda body, more=more: body + more)
        for sizes in ((0, 0), (2**32 - 1, size), (count, 2**32 - 1), (2**30, 8)):
            yield f"{name}: sizes {sizes}", with_body(name, lambda b, s=sizes: MODEL.pack(*s) + b[8:])
        rows = {"means": 2, "splats": 10, "latents": 8}[name]
        near = [rows, 0], [0, COUNT], [rows, COUNT - 1], [rows - 1, COUNT]
        for shape in ([rows, 10**6], [10**6, 1], [1024, 2000], *near):
            yield f"{name}: shape {shape}", with_body(name, lambda body: body, shape=shape)
        for dtype in ("int16", "int32", "uint32"):
            yield f"{name}: {dtype}", with_body(name, lambda body: body, dtype=dtype)


@cache
def encoded() -> tuple[dict, dict]:
    return encode(field(COUNT), dict(RENDER))


def with_stream(name: str, stream) -> bytes:
    """A file in which one stream is another array or table."""
    fields, streams = encoded()
    return container(fields, streams | {name: stream})


def contents() -> Iterator[tuple[str, bytes]]:
    """Numbers in tables and weights that no field has, or that just fit."""
    fields, streams = encoded()
    weights = streams["head.low.0.weight"]
    for value in (np.nan, np.inf, -np.inf, 6e4, 1e-7, -0.0):
        for dtype in ("float16", "float32"):
            other = weights.astype(dtype)
            other[3, 5] = value
            yield f"a weight {value} in {dtype}", with_stream("head.low.0.weight", other)
    for kind, other in {
        "turned": weights.T,
        "flat": weights.ravel(),
        "of a unit more": np.concatenate([weights, weights[:1]]),
        "uint8": weights.astype(np.uint8),
        "uint16": weights.astype(np.uint16),
        "a table": Table(np.rint(weights * 100).astype(np.int64)),
    }.items():
        yield f"weights {kind}", with_stream("head.low.0.weight", other)
    for name, table in {name: stream for name, stream in streams.items() if isinstance(stream, Table)}.items():
        for value in (-(2**31), -1, 2**15, 2**31 - 1, 2**31, 2**32 - 1):
            for row in (0, 1, len(table.numbers) - 1):
                for signed in (True, False):
                    numbers = table.numbers.astype(np.int64).copy()
                    numbers[row, 7] = value
                    if (signed or numbers.min() >= 0) and not (signed and numbers.max() >= 2**31):
                        yield f"{name}: {value} in {row}, {signed}", with_stream(name, Table(numbers, signed))
        yield f"{name} in xz", with_stream(name, np.abs(table.numbers).astype(np.uint32))
    yield "means beyond 64 bits", with_stream("means", Table(np.full((2, COUNT), 2**31 - 1), signed=False))
    for name, grid in fields["grids"].items():
        for part in ("low", "step"):
            for value in (1e-320, 1e37, 1e38, 3.5e38, 1e308, -1e38, 0):
                changed = deepcopy(fields)
                changed["grids"][name][part] = [value] * len(grid[part])
                yield f"{name} {part} {value}", container(changed, streams)


def whole_files() -> Iterator[tuple[str, bytes]]:
    """Fields of other kinds, which both read, and tables of few splats or none."""
    for options in (
        {},
        {"split_bands": False},
        {"num_bands": 1},
        {"num_bands": 16},
        {"opacity_residual": False, "use_distance": False, "hidden_width": 3},
        {"opacity_bound": "logit", "color_scale": 0, "precision": "fp32", "implementation": "torch"},
    ):
        yield f"with {options}", written(12, **options)
    yield "a lone splat", written(1)
    header, streams = encode(field(4), dict(RENDER))
    header["splats"] = 0
    streams |= {"means": Table(np.zeros((2, 0)), signed=False)}
    streams |= {"splats": Table(np.zeros((10, 0))), "latents": Table(np.zeros((8, 0)))}
    yield "no splat", container(header, streams)
    yield "wide latents", written(4, latent_dim=1024, hidden_width=1)
    for value in ([0, 0.5, 1], [0, 0, 2], [0, 0, True], [0, 0, -0.1]):
        header, bodies = parts()
        header["render"]["background"] = value
        yield f"background {value}", joined(header, bodies)


GROUPS = (headers, texts, containers, xz_streams, rans_streams, contents, whole_files)


READ = """
const heard = (bytes) => {
  let parts;
  try {
    parts = [...readScene(bytes, [])];
  } catch (error) {
    return { said: error.message, raw: !(error instanceof BadFile) };
  }
  const [{ scene }] = parts, table = parts.find((part) => part.table).table[1].slice(0, 16 * scene.count);
  const { low, step } = scene.header.grids.latents, layers = parts.filter((part) => part.latents);
  const value = (code, r) => low[r] + step[r] * code || 0;  // 0 beyond the rank
  const row = (_, i) => layers.flatMap(({ latents: [, codes] }) => [...codes.subarray(4 * i, 4 * i + 4)]).map(value);
  const text = (values) => btoa(String.fromCharCode(...new Uint8Array(values.buffer).subarray(0, 6400)));
  return { table: text(table), latents: text(Float32Array.from(Array.from({ length: scene.count }, row).flat())) };
};
const cases = JSON.parse(require("fs").readFileSync("cases.json", "utf-8"));
console.log(JSON.stringify(cases.map((text) => heard(new Uint8Array(Buffer.from(text, "base64"))))));
"""
"""What the page's reader says of each file of cases.json."""


def in_python(data: bytes, path: Path) -> Decoded | str:
    path.write_bytes(data)
    try:
        return decode(path)
    except InputError as error:
        return str(error)


def same_numbers(decoded: Decoded, heard: dict) -> None:
    """The page's table and latents, of the first hundred splats, are Python's."""
    splats = decoded.splats
    table = np.frombuffer(base64.b64decode(heard["table"]), "<f4").reshape(-1, 16)
    count, rank = len(table), decoded.config.latent_dim
    assert count == min(len(splats["means"]), 100)
    alike = {"rtol": 2**-20, "atol": 2**-22}
    for first, value in (
        (0, splats["means"]),
        (3, splats["opacities"]),
        (4, splats["quats"]),
        (8, splats["scales"].exp()),
        (12, base_colors(splats["features_dc"])),
    ):
        assert_close(torch.tensor(table[:, first : first + value.shape[1]]), value[:count], **alike)
    width = rank + -rank % 4
    latents = np.frombuffer(base64.b64decode(heard["latents"]), "<f4")
    latents = latents[: len(latents) // width * width].reshape(-1, width)[:, :rank]
    assert_close(torch.tensor(latents.copy()), splats["latents"][: len(latents)], **alike)


@pytest.mark.skipif(shutil.which("node") is None, reason="no node: the page's reader is tried by pytest -m browser")
@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)
def test_both_readers_refuse_the_same_files(group, tmp_path):
    cases = dict(group())
    (tmp_path / "cases.json").write_text(json.dumps([base64.b64encode(data).decode() for data in cases.values()]))
    wrong, read = [], 0
    for (name, data), heard in zip(cases.items(), in_node(READ, tmp_path), strict=True):
        python = in_python(data, tmp_path / "f.nrf")
        if isinstance(python, Decoded) == ("said" in heard):
            wrong.append((name, python if isinstance(python, str) else "read", heard.get("said", "read")))
        elif isinstance(python, Decoded):
            same_numbers(python, heard)
            read += 1
        elif heard["raw"] or not heard["said"].startswith("The ") or heard["said"].count(". ") or "\n" in heard["said"]:
            wrong.append((name, "unclear", heard["said"]))
    assert not wrong, (len(wrong), wrong[:20])
    assert read < len(cases)


def test_what_is_read_can_be_shown(tmp_path):
    """`nrfgs view` takes what the reader takes."""
    for name, data in whole_files():
        if isinstance(in_python(data, tmp_path / "f.nrf"), Decoded):
            assert load_file(tmp_path / "f.nrf").num_points > 0, name


def test_the_pages_defaults_are_pythons():
    text = (files("nrfgs_ns.export.web") / "compact.js").read_text(encoding="utf-8")
    found = json.loads(text.split("const OPTIONS = ")[1].split(";")[0])
    usual = NrfConfig(opacity_bound=NrfConfig().bound)
    assert found == {name: value for name, value in vars(usual).items() if name != "_target"}
