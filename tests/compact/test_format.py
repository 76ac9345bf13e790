# SPDX-License-Identifier: Apache-2.0
"""The container and its coded tables: what goes in comes out, in Python and in the page's reader; what is damaged is
refused. tests/attack has headers that mislead."""

import hashlib
import json
import shutil
import struct
import zlib

import numpy as np
import pytest
from compact_fields import in_node, read_container, write_container
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.compact.entropy import decode_table, encode_table
from nrfgs_ns.compact.format import BROKEN, DTYPES, Table


def laplacian(columns: int, rows: int, scale: float = 5.0, seed: int = 0) -> np.ndarray:
    """Columns that follow their neighbours, and each other."""
    steps = np.random.default_rng(seed).laplace(size=(columns, rows)) * scale * (1 + np.sin(np.arange(rows) / 50))
    return np.rint(steps + 0.8 * np.roll(steps, 1, axis=0) + np.cumsum(steps, axis=1) * 0.2).astype(np.int64)


RANDOM = np.random.default_rng(0)
ARRAYS = {
    **{name: RANDOM.integers(0, np.iinfo(name).max, (3, 17), dtype=name) for name in DTYPES if "uint" in name},
    "half": RANDOM.normal(size=(5,)).astype("float16"),
    "none": np.zeros((2, 0), dtype="float32"),
}
TABLES = {
    "no rows": Table(np.zeros((3, 0))),
    "no columns": Table(np.zeros((0, 7))),
    "one": Table(np.array([[-7]])),
    "constant": Table(np.full((2, 5000), 3)),
    "small": Table(laplacian(3, 17)),
    "lanes of unequal length": Table(laplacian(11, 4099)),
    "large": Table(laplacian(1, 3000, 1e6)),
    "largest": Table(np.array([[2**31 - 1, -(2**31), 0, 2**31 - 1, -(2**31)]])),
    "unsigned": Table(RANDOM.integers(0, 2**32, (2, 2500)), signed=False),
    "unsigned and small": Table(RANDOM.integers(0, 3, (2, 2500)), signed=False),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A file of ARRAYS and TABLES."""
    path = tmp_path_factory.mktemp("compact") / "deep" / "file.nrf"
    assert write_container(path, {"format": "x", "list": [1.5, None]}, ARRAYS | TABLES) == path.stat().st_size
    assert [path.name for path in path.parent.iterdir()] == ["file.nrf"], "nothing is left beside it"
    return path.read_bytes()


def test_what_goes_in_comes_out(written):
    header, streams = read_container(written)
    assert header["format"] == "x" and header["list"] == [1.5, None]
    assert list(streams) == [*ARRAYS, *TABLES]
    for name, array in ARRAYS.items():
        assert streams[name].shape == array.shape and streams[name].dtype == array.dtype
        assert (streams[name] == array).all()
    for name, table in TABLES.items():
        assert streams[name].shape == table.numbers.shape and (streams[name] == table.numbers).all()
    dtypes = {"small": np.int16, "large": np.int32, "unsigned and small": np.uint32}
    assert {name: streams[name].dtype for name in dtypes} == dtypes


def test_layout_is_as_documented_and_another_version_is_told(written):
    magic, version, length, total = struct.unpack("<8sIIQ", written[:24])
    assert magic == b"\x89NRF\r\n\x1a\n" and version == 3 and total == len(written)
    assert struct.unpack("<I", written[24 + length : 28 + length]) == (zlib.crc32(written[: 24 + length]),)
    first = 28 + length
    for entry in json.loads(written[24 : 24 + length])["streams"]:
        assert entry["coding"] == ("rans" if entry["name"] in TABLES else "xz")
        assert zlib.crc32(written[first : first + entry["bytes"]]) == entry["crc32"]
        start = first + (8 if entry["coding"] == "rans" else 0)
        assert written[start : start + 6] == b"\xfd7zXZ\x00"
        first += entry["bytes"]
    assert first == len(written)
    with pytest.raises(ValueError, match="is of version 4 of the format"):
        read_container(written[:8] + b"\4" + written[9:])


@settings(max_examples=150)
@given(data=st.data())
def test_a_changed_byte_is_noticed(data, written):
    """CRC-32 finds every change of one byte; the length finds the file's own."""
    changed = bytearray(written)
    at = st.integers(0, 4000) | st.integers(0, len(written) - 1)  # the header and small streams, or anywhere
    changed[data.draw(at)] ^= data.draw(st.integers(1, 255))
    with pytest.raises(BROKEN):
        read_container(bytes(changed))


@settings(max_examples=60)
@given(data=st.data())
def test_a_cut_or_longer_file_is_noticed(data, written):
    cut = written[: data.draw(st.integers(0, len(written) - 1))]
    for broken in (cut, written + data.draw(st.binary(min_size=1, max_size=9))):
        with pytest.raises(BROKEN):
            read_container(broken)


@settings(max_examples=60)
@given(
    st.integers(1, 4),
    st.integers(1, 300),
    st.sampled_from([1, 3, 100, 10**5, 2**31 - 1]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_any_table_comes_back(columns, rows, largest, signed, seed):
    table = np.random.default_rng(seed).integers(-largest if signed else 0, largest, (columns, rows), endpoint=True)
    assert (decode_table(*encode_table(table, signed), columns, rows) == table).all()


def test_it_takes_what_entropy_says_and_less_of_like_neighbours():
    """Independent numbers cannot take less than their entropy; this takes 1 % more, and a model."""
    table = np.rint(np.random.default_rng(3).laplace(size=(4, 50_000)) * 3).astype(np.int64)
    model, data = encode_table(table)
    _, counts = np.unique(table, return_counts=True)
    entropy = -(counts * np.log2(counts / counts.sum())).sum() / 8
    assert entropy * 0.999 < len(data) < entropy * 1.01
    assert len(model) < 2000
    table = laplacian(3, 30_000)
    shuffled = table[:, np.random.default_rng(0).permutation(30_000)]
    assert len(encode_table(table)[1]) < 0.8 * len(encode_table(shuffled)[1])


SMALL = encode_table(laplacian(2, 200))


@settings(max_examples=200)
@given(st.data())
def test_a_changed_byte_of_a_table_is_refused_or_gives_numbers(data):
    """Without a checksum in front of it: whatever it is given, it ends, with numbers or with ValueError."""
    model, stream = SMALL
    if data.draw(st.booleans()):
        stream = bytearray(stream)
        stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(st.integers(1, 255))
    else:
        model = model.copy()
        model[data.draw(st.integers(0, len(model) - 1))] = data.draw(st.integers(-(2**31), 2**31 - 1))
    try:
        assert decode_table(model, bytes(stream), 2, 200).shape == (2, 200)
    except ValueError:
        pass


@pytest.mark.parametrize("columns, rows", [(2, 199), (2, 201), (1, 200), (3, 200), (2, 10_000)])
def test_another_shape_is_refused(columns, rows):
    with pytest.raises(ValueError):
        decode_table(*SMALL, columns, rows)


@pytest.mark.skipif(shutil.which("node") is None, reason="no node: the page's reader is tried by pytest -m browser")
def test_the_pages_reader_finds_the_same_numbers(tmp_path):
    write_container(tmp_path / "tables.nrf", {}, {**TABLES, "plain": np.arange(5, dtype=np.uint16)})
    for name, found in in_node(READ, tmp_path, "tables.nrf").items():
        table, signed = TABLES[name]
        assert found == hashlib.sha256(table.astype("<i4" if signed else "<u4").tobytes()).hexdigest(), name


READ = """
const fs = require("fs"), crypto = require("crypto");
const { streams } = readContainer(new Uint8Array(fs.readFileSync(process.argv[2])));
const found = {};
for (const [name, stream] of streams) {
  if (stream.coding !== "rans") continue;
  const hash = crypto.createHash("sha256"), column = new Uint32Array(stream.shape[1]);
  for (const write of decodeTable(stream)) hash.update((write(column, 0, 1), new Uint8Array(column.buffer)));
  found[name] = hash.digest("hex");
}
console.log(JSON.stringify(found));
"""
