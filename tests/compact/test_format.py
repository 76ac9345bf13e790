# SPDX-License-Identifier: Apache-2.0
"""The container: what goes in comes out, and what is damaged is refused. tests/attack has headers that mislead."""

import json
import struct
import zlib

import numpy as np
import pytest
from compact_fields import read_container, write_container
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.compact.format import BROKEN, DTYPES, Table

RANDOM = np.random.default_rng(0)
ARRAYS = {
    **{name: RANDOM.integers(0, np.iinfo(name).max, (3, 17), dtype=name) for name in DTYPES if "uint" in name},
    "half": RANDOM.normal(size=(5,)).astype("float16"),
    "none": np.zeros((2, 0), dtype="float32"),
}
TABLES = {
    "signed": Table(RANDOM.integers(-99, 99, (3, 300))),
    "not signed": Table(RANDOM.integers(0, 2**32, (2, 100)), signed=False),
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
        assert (streams[name] == table.numbers).all()
    assert streams["signed"].dtype == np.int16 and streams["not signed"].dtype == np.uint32


def test_layout_is_as_documented(written):
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


@settings(max_examples=150)
@given(data=st.data())
def test_a_changed_byte_is_noticed(data, written):
    """CRC-32 finds every change of one byte; the length finds the file's own."""
    changed = bytearray(written)
    changed[data.draw(st.integers(0, len(written) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(BROKEN):
        read_container(bytes(changed))


@settings(max_examples=60)
@given(data=st.data())
def test_a_cut_or_longer_file_is_noticed(data, written):
    cut = written[: data.draw(st.integers(0, len(written) - 1))]
    for broken in (cut, written + data.draw(st.binary(min_size=1, max_size=9))):
        with pytest.raises(BROKEN):
            read_container(broken)


def test_another_version_is_told(written):
    with pytest.raises(ValueError, match="is of version 4 of the format"):
        read_container(written[:8] + b"\4" + written[9:])
