# SPDX-License-Identifier: Apache-2.0
"""The container: named arrays of integers or floats, compressed, each with a checksum, behind a JSON header.

    offset  bytes
    0       8      magic: 89 4E 52 46 0D 0A 1A 0A ("NRF" between bytes that a transfer as text would change)
    8       4      version of the format, uint32
    12      4      length L of the header, uint32
    16      8      length of the whole file, uint64
    24      L      header: a JSON object in UTF-8, with a list "streams"
    24 + L  4      CRC-32 of everything before, uint32
    28 + L         the streams, one after the other, in the order of the list

All numbers are little-endian. An entry of "streams" has "name", "coding", "dtype" (of the numbers), "shape", "bytes"
(in the file) and "crc32" (of these bytes).

"xz": the xz format, as one block of LZMA2 without sizes in its header and without a check; unpacked, the numbers'
bytes by significance: first every number's lowest byte, then every number's next, and so on; numbers (uint8, uint16,
uint32, uint64, float16 or float32) in row-major order.
"rans": a table [columns, rows] of int16, int32 or uint32, by an entropy coder:

    bytes
    4      number of integers in the coder's model, uint32
    4      bytes of the packed model, uint32
           the model, int32 numbers, packed as in "xz"
           the coder's output (`entropy.py`)

`encode.py` lists the streams. The version is 3.

Nothing in a file is ever run. docs/compact-format.md lists what every reader refuses.
"""

import json
import lzma
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nrfgs_ns.compact.entropy import MOST_MODEL, decode_table, encode_table, expect

MAGIC = b"\x89NRF\r\n\x1a\n"
VERSION = 3
PREAMBLE = struct.Struct("<8sIIQ")
CHECKSUM = struct.Struct("<I")
MODEL = struct.Struct("<II")
"""Integers in a coded table's model, and bytes."""
DTYPES = ("uint8", "uint16", "uint32", "uint64", "float16", "float32")
CODINGS = {"xz": DTYPES, "rans": ("int16", "int32", "uint32")}
"""Codings, and the types of numbers that each holds."""
LARGEST_RATIO = 32
"""Largest unpacked size, in sizes of the file. Files of results/compact.json reach ten."""
SMALL = 2**24
"""Bytes to which any file may unpack."""
MOST_COLUMNS = 1024
"""Largest number of columns in a coded table."""
LARGEST_DICTIONARY = 2**26
"""Bytes within which xz looks for repetitions."""
LARGEST_MEMORY = 2**28
"""Bytes that xz may take to unpack: more than the dictionary needs."""
ONE_BLOCK = b"\x02\x00\x21\x01"
"""How the header of a block begins: its length, no sizes, LZMA2, one byte of properties."""
BROKEN = OSError, LookupError, TypeError, ValueError, AttributeError, OverflowError, RuntimeError
BROKEN += lzma.LZMAError, struct.error
"""Errors of reading a damaged or hostile file."""


class Table(NamedTuple):
    """Integers for the entropy coder (`entropy.py`)."""

    numbers: np.ndarray
    """[C, n]"""
    signed: bool = True
    """from -2^31 to 2^31 - 1, and like their neighbours; False: from 0 to 2^32 - 1"""


def container(header: Mapping[str, Any], streams: Mapping[str, np.ndarray | Table]) -> bytes:
    """The bytes of a file.

    Args:
        header: what JSON can hold; "streams" is added.
        streams: arrays of DTYPES, and tables.
    """
    entries, bodies = [], []
    for name, stream in streams.items():
        coding = "rans" if isinstance(stream, Table) else "xz"
        array, body = _coded(stream) if coding == "rans" else (stream, _pack(stream))
        sizes = {"dtype": array.dtype.name, "shape": list(array.shape), "bytes": len(body)}
        entries.append({"name": name, "coding": coding, **sizes, "crc32": zlib.crc32(body)})
        bodies.append(body)
    text = json.dumps({**header, "streams": entries}, allow_nan=False).encode("utf-8")
    total = PREAMBLE.size + len(text) + CHECKSUM.size + sum(map(len, bodies))
    start = PREAMBLE.pack(MAGIC, VERSION, len(text), total) + text
    return b"".join([start, CHECKSUM.pack(zlib.crc32(start)), *bodies])


def read_header(data: bytes) -> tuple[dict[str, Any], int]:
    """The header of a file's bytes, and where its streams begin; one of BROKEN if it is damaged or of another kind."""
    expect(data.startswith(MAGIC), f"it begins with {data[: len(MAGIC)]!r}")
    _, version, length, total = PREAMBLE.unpack_from(data)
    # Another version may be laid out differently.
    expect(version == VERSION, f"it is of version {version} of the format, and this program reads version {VERSION}")
    header_end = PREAMBLE.size + length
    whole = len(data) == total and zlib.crc32(data[:header_end]) == CHECKSUM.unpack_from(data, header_end)[0]
    expect(whole, f"it is damaged or cut short: {len(data)} bytes, of {total}")
    return read_json(data[PREAMBLE.size : header_end]), header_end + CHECKSUM.size


def read_streams(data: bytes, entries: list[dict[str, Any]], first: int) -> dict[str, np.ndarray]:
    """The streams, from byte `first` on, that the header's entries describe; errors as `read_header`."""
    unpacked = 0
    streams = {}
    for entry in entries:
        named = f"the stream {ascii(entry)}"
        check_keys(entry, ("name", "coding", "dtype", "shape", "bytes", "crc32"), named)
        sizes = entry["shape"]
        kinds = type(entry["name"]), type(sizes), type(entry["bytes"])
        expect(kinds == (str, list, int) and entry["dtype"] in CODINGS[entry["coding"]], named)
        expect(entry["name"] not in streams and all(type(size) is int and size >= 0 for size in sizes), named)
        unpacked += math.prod(max(size, 1) for size in sizes) * np.dtype(entry["dtype"]).itemsize
        room = max(LARGEST_RATIO * len(data), SMALL)
        expect(unpacked <= room, f"{named} would unpack to more than {LARGEST_RATIO} times the file")
        body = data[first : first + entry["bytes"]]
        first += entry["bytes"]
        whole = len(body) == entry["bytes"] and zlib.crc32(body) == entry["crc32"]
        expect(whole, f"the checksum of its stream {entry['name']!r} does not hold")
        streams[entry["name"]] = (_uncoded if entry["coding"] == "rans" else _unpack)(entry, body)
    expect(first == len(data), f"it has {len(data) - first} bytes after its last stream")
    return streams


def read_json(text: bytes) -> dict[str, Any]:
    """An object in UTF-8 as every JSON reader has it: numbers are finite float64, and those without a fraction int."""

    def number(digits: str) -> int | float:
        expect(math.isfinite(value := float(digits)), f"{digits[:20]} is no number")
        return int(value) if value.is_integer() else value

    return json.loads(text.decode("utf-8"), parse_int=number, parse_float=number, parse_constant=number)


def check_keys(value: Any, keys: Sequence[str], what: str, optional: Sequence[str] = ()) -> None:
    """Raise ValueError unless a value is an object with these keys."""
    right = isinstance(value, dict) and set(keys) <= value.keys() <= {*keys, *optional}
    expect(right, f"{what} has not the keys {', '.join(keys)}, or has others")


def _pack(array: np.ndarray) -> bytes:
    """The bytes of "xz", compressed without context: neighbours tell nothing of a number's byte."""
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).reshape(-1, 1)
    raw = little.view(np.uint8).T.tobytes()
    options = {"id": lzma.FILTER_LZMA2, "preset": 9, "lc": 0, "lp": 0, "pb": 0}
    options["dict_size"] = min(max(len(raw), 4096), LARGEST_DICTIONARY)
    return lzma.compress(raw, format=lzma.FORMAT_XZ, check=lzma.CHECK_NONE, filters=[options])


def _unpack(entry: Mapping[str, Any], body: bytes) -> np.ndarray:
    count = math.prod(entry["shape"])
    size = np.dtype(entry["dtype"]).itemsize
    unpacker = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=LARGEST_MEMORY)
    raw = unpacker.decompress(body, max_length=count * size + 1) if body else b""
    complete = not body or unpacker.eof and not unpacker.unused_data and unpacker.check == lzma.CHECK_NONE
    expect(complete and len(raw) == count * size, f"it does not hold {count} numbers of {size} bytes")
    # Its index, whose length is at the end, begins with 0 and the number of blocks, up to 127.
    blocks = body[-12 - 4 * (int.from_bytes(body[-8:-4], "little") + 1) + 1] if body else 0
    plain = blocks == 0 or blocks == 1 and body.startswith(ONE_BLOCK, 12)
    expect(plain, f"it is packed in {blocks} blocks or with other filters")
    planes = np.frombuffer(raw, dtype=np.uint8).reshape(size, count)
    return np.ascontiguousarray(planes.T).view(np.dtype(entry["dtype"]).newbyteorder("<")).reshape(entry["shape"])


def _coded(table: Table) -> tuple[np.ndarray, bytes]:
    """A table in its narrowest type, and the bytes of "rans"."""
    low, high = int(table.numbers.min(initial=0)), int(table.numbers.max(initial=0))
    dtype = "uint32" if not table.signed else "int16" if -(2**15) <= low and high < 2**15 else "int32"
    model, words = encode_table(table.numbers, table.signed)
    packed = _pack(model)
    return table.numbers.astype(dtype), MODEL.pack(len(model), len(packed)) + packed + words


def _uncoded(entry: Mapping[str, Any], body: bytes) -> np.ndarray:
    columns, rows = entry["shape"]
    count, size = MODEL.unpack_from(body)
    small = columns <= MOST_COLUMNS and count <= columns * MOST_MODEL
    expect(small, f"a model of {count} numbers for {columns} columns is too large")
    model = _unpack({"shape": [count], "dtype": "int32"}, body[MODEL.size : MODEL.size + size])
    table = decode_table(model, body[MODEL.size + size :], columns, rows)
    bounds = np.iinfo(entry["dtype"])
    fits = not table.size or bounds.min <= table.min() <= table.max() <= bounds.max
    expect(fits, f"it holds numbers that are no {entry['dtype']}")
    return table.astype(entry["dtype"])
