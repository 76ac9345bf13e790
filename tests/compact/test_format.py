# SPDX-License-Identifier: Apache-2.0
"""The container: what goes in comes out, and what is damaged is refused."""

import json
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.compact.format import (
    CHECKSUM,
    DTYPES,
    MAGIC,
    MODEL,
    PREAMBLE,
    SMALL,
    Table,
    read_container,
    write_container,
)
from nrfgs_ns.errors import InputError


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    whole = {name: random.integers(0, np.iinfo(name).max, (3, 17), dtype=name) for name in DTYPES if "uint" in name}
    return {**whole, "half": random.normal(size=(5,)).astype("float16"), "none": np.zeros((2, 0), dtype="float32")}


@pytest.fixture(scope="module")
def written(arrays, tmp_path_factory):
    path = tmp_path_factory.mktemp("compact") / "deep" / "file.nrf"
    assert write_container(path, {"format": "x", "list": [1.5, None]}, arrays) == path.stat().st_size
    return path


TABLES = {
    "signed": Table(np.random.default_rng(1).integers(-99, 99, (3, 300))),
    "not signed": Table(np.random.default_rng(2).integers(0, 2**32, (2, 100)), signed=False),
}


@pytest.fixture(scope="module")
def coded(arrays, tmp_path_factory):
    path = tmp_path_factory.mktemp("compact") / "coded.nrf"
    write_container(path, {}, {**TABLES, "half": arrays["half"]})
    return path


def test_what_goes_in_comes_out(arrays, written):
    header, streams = read_container(written)
    assert header["format"] == "x" and header["list"] == [1.5, None]
    assert list(streams) == list(arrays)
    for name, array in arrays.items():
        assert streams[name].shape == array.shape and streams[name].dtype == array.dtype
        assert (streams[name] == array).all()
    assert [path.name for path in written.parent.iterdir()] == ["file.nrf"], "nothing is left beside it"


def test_layout_is_as_documented(written):
    data = written.read_bytes()
    magic, version, length, total = struct.unpack("<8sIIQ", data[:24])
    assert magic == b"\x89NRF\r\n\x1a\n" and version == 2 and total == len(data)
    header = json.loads(data[24 : 24 + length])
    assert struct.unpack("<I", data[24 + length : 28 + length]) == (zlib.crc32(data[: 24 + length]),)
    first = 28 + length
    for entry in header["streams"]:
        assert zlib.crc32(data[first : first + entry["bytes"]]) == entry["crc32"]
        assert data[first : first + 6] == b"\xfd7zXZ\x00"
        first += entry["bytes"]
    assert first == len(data)


def test_tables_are_coded(arrays, coded):
    header, streams = read_container(coded)
    assert [entry["coding"] for entry in header["streams"]] == ["rans", "rans", "xz"]
    for name, table in TABLES.items():
        assert (streams[name] == table.numbers).all()
    assert streams["signed"].dtype == np.int16 and streams["not signed"].dtype == np.uint32
    assert (streams["half"] == arrays["half"]).all()


@settings(max_examples=150)
@given(data=st.data())
def test_a_changed_byte_is_noticed(data, written, tmp_path_factory):
    """CRC-32 finds every change of one byte; the length finds the file's own."""
    whole = written.read_bytes()
    where = data.draw(st.integers(0, len(whole) - 1))
    changed = bytearray(whole)
    changed[where] ^= data.draw(st.integers(1, 255))
    broken = written.parent.parent / "broken.nrf"
    broken.write_bytes(changed)
    with pytest.raises(InputError, match="broken.nrf"):
        read_container(broken)


@settings(max_examples=60)
@given(data=st.data())
def test_a_cut_or_longer_file_is_noticed(data, written):
    whole = written.read_bytes()
    cut = written.parent.parent / "cut.nrf"
    cut.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(InputError, match="cut.nrf"):
        read_container(cut)
    cut.write_bytes(whole + data.draw(st.binary(min_size=1, max_size=9)))
    with pytest.raises(InputError, match="cut.nrf"):
        read_container(cut)


def rewritten(path, change) -> None:
    """Change a file's header, or the version that `change` returns, and fix its checksum and length."""
    data = path.read_bytes()
    _, version, length, _ = PREAMBLE.unpack_from(data)
    header = json.loads(data[PREAMBLE.size : PREAMBLE.size + length])
    version = change(header) or version
    text, body = json.dumps(header).encode(), path.read_bytes()[PREAMBLE.size + length + CHECKSUM.size :]
    start = PREAMBLE.pack(MAGIC, version, len(text), PREAMBLE.size + len(text) + CHECKSUM.size + len(body)) + text
    path.write_bytes(start + CHECKSUM.pack(zlib.crc32(start)) + body)


@pytest.mark.parametrize(
    "file, change, says",
    [
        ("written", lambda header: 3, "is of version 3 of the format"),
        ("written", lambda header: header["streams"][0].update(shape=[3, 18]), "does not hold 54 numbers"),
        ("written", lambda header: header["streams"][0].update(shape=[2**40]), "would unpack to"),
        ("written", lambda header: header["streams"][0].update(shape=[0, 2**62]), "would unpack to"),
        ("written", lambda header: header["streams"][0].update(crc32=1), "checksum of its stream"),
        ("written", lambda header: header["streams"].pop() and None, "after its last stream"),
        ("written", lambda header: header.update(streams=3), "int"),
        ("coded", lambda header: header["streams"][0].update(coding="zip"), "zip"),
        ("coded", lambda header: header["streams"][0].update(dtype="float16"), "the stream .*'float16'"),
        ("coded", lambda header: header["streams"][0].update(dtype="uint32"), "no uint32"),
        ("coded", lambda header: header["streams"][0].update(shape=[3, 301]), "cut short"),
        ("coded", lambda header: header["streams"][0].update(shape=[10**6, 1]), "too large"),
        ("coded", lambda header: header["streams"][0].update(shape=[3, 10**9]), "would unpack to"),
    ],
)
def test_a_misleading_header_is_refused(file, change, says, request, tmp_path):
    path = tmp_path / "made.nrf"
    path.write_bytes(request.getfixturevalue(file).read_bytes())
    rewritten(path, change)
    with pytest.raises(InputError, match=f"made.nrf.*{says}"):
        read_container(path)


@pytest.mark.parametrize("count, size", [(2**32 - 1, 10), (SMALL // 4 + 1, 10), (5, 2**32 - 1), (0, 0), (5, 3)])
def test_a_misleading_model_of_a_table_is_refused(count, size, coded, tmp_path):
    path = tmp_path / "made.nrf"
    path.write_bytes(coded.read_bytes())

    def change(header):
        data = bytearray(path.read_bytes())
        _, _, length, _ = PREAMBLE.unpack_from(data)
        first, entry = PREAMBLE.size + length + CHECKSUM.size, header["streams"][0]
        MODEL.pack_into(data, first, count, size)
        entry["crc32"] = zlib.crc32(data[first : first + entry["bytes"]])
        path.write_bytes(data)

    rewritten(path, change)
    with pytest.raises(InputError, match="made.nrf cannot be read"):
        read_container(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="it is no file"):
        read_container(tmp_path / "none.nrf")
    (tmp_path / "text.nrf").write_text("ply\nformat binary_little_endian 1.0\n" * 9)
    with pytest.raises(InputError, match="it begins with"):
        read_container(tmp_path / "text.nrf")
