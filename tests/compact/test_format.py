# SPDX-License-Identifier: Apache-2.0
"""The container: what goes in comes out, and what is damaged is refused. tests/attack has headers that mislead."""

import json
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.compact.format import DTYPES, Table, read_container, write_container
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


def test_tables_are_coded(arrays, tmp_path):
    write_container(tmp_path / "coded.nrf", {}, {**TABLES, "half": arrays["half"]})
    header, streams = read_container(tmp_path / "coded.nrf")
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


def test_another_version_is_told(written, tmp_path):
    data = bytearray(written.read_bytes())
    data[8] = 3
    (tmp_path / "new.nrf").write_bytes(data)
    with pytest.raises(InputError, match="new.nrf .*is of version 3 of the format"):
        read_container(tmp_path / "new.nrf")
