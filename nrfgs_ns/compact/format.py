# SPDX-License-Identifier: Apache-2.0
"""The container: named arrays of whole numbers or floats, compressed, each with a checksum, behind a JSON header.

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

"xz": the xz format; unpacked, the numbers' bytes by significance: first every number's lowest byte, then every number's
next, and so on; numbers (uint8, uint16, uint32, uint64, float16 or float32) in row-major order.
"rans": a table [columns, rows] of int16, int32 or uint32, by an entropy coder:

    bytes
    4      how many numbers the coder's model has, uint32
    4      bytes of the packed model, uint32
           the model, int32 numbers, packed as in "xz"
           what the coder wrote (`entropy.py`)

`encode.py` says which streams there are. The version is 2; a reader refuses any other, another length than the file's,
and a checksum that does not hold.

Nothing in a file is ever run, and nothing is allocated before its size was checked against the lengths in the header,
and these against the size of the file: it cannot unpack to more than 32 times that, or 16 MB.
"""

import json
import lzma
import math
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nrfgs_ns.compact.entropy import MOST_MODEL, decode_table, encode_table
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole

MAGIC = b"\x89NRF\r\n\x1a\n"
VERSION = 2
PREAMBLE = struct.Struct("<8sIIQ")
CHECKSUM = struct.Struct("<I")
MODEL = struct.Struct("<II")
"""Numbers of a coded table's model, and its bytes."""
DTYPES = ("uint8", "uint16", "uint32", "uint64", "float16", "float32")
ENTRY = {"name": str, "coding": str, "dtype": str, "shape": list, "bytes": int, "crc32": int}
"""Keys of a stream's entry in the header, and their types."""
CODINGS = {"xz": DTYPES, "rans": ("int16", "int32", "uint32")}
"""Codings, and the types of numbers that each holds."""
LARGEST_RATIO = 32
"""Times its own size that a file may unpack to. Those of results/compact.json unpack to at most ten times theirs."""
SMALL = 2**24
"""Bytes that any file may unpack to."""
MOST_AXES = 4
MOST_COLUMNS = 1024
"""Of a coded table."""
LARGEST_DICTIONARY = 2**26
"""Bytes within which xz looks for repetitions."""
LARGEST_MEMORY = 2**28
"""Bytes that xz may take to unpack: more than the dictionary needs."""


class Table(NamedTuple):
    """Whole numbers that an entropy coder packs (`entropy.py`)."""

    numbers: np.ndarray
    """[C, n]"""
    signed: bool = True
    """False: from 0 to 2^32 - 1, each on its own; otherwise from -2^31 to 2^31 - 1, like their neighbours"""


def write_container(path: Path, header: Mapping[str, Any], streams: Mapping[str, np.ndarray | Table]) -> int:
    """Write a file, whole or not at all; returns its size.

    Args:
        header: what JSON can hold; "streams" is added.
        streams: arrays of DTYPES, and tables.
    """
    entries, bodies = [], []
    for name, stream in streams.items():
        if isinstance(stream, Table):
            array, body, coding = _coded(stream)
        else:
            array, body, coding = stream, _pack(_planes(stream)), "xz"
        sizes = {"dtype": array.dtype.name, "shape": list(array.shape), "bytes": len(body)}
        entries.append({"name": name, "coding": coding, **sizes, "crc32": zlib.crc32(body)})
        bodies.append(body)
    text = json.dumps({**header, "streams": entries}, allow_nan=False).encode("utf-8")
    total = PREAMBLE.size + len(text) + CHECKSUM.size + sum(map(len, bodies))
    start = PREAMBLE.pack(MAGIC, VERSION, len(text), total) + text
    with whole(path) as aside:
        aside.write_bytes(b"".join([start, CHECKSUM.pack(zlib.crc32(start)), *bodies]))
    return total


def read_container(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and the streams, by name, of a file.

    Raises:
        InputError: there is no such file, it is of another kind or version, or damaged.
    """
    try:
        data = path.read_bytes() if path.is_file() else None
    except OSError:
        data = None
    if data is None:
        raise InputError(f"{path} cannot be read as a file. Export it again, or fix the path.")
    fix = "Copy it again, or export it again with nrfgs export compact."
    if data[: len(MAGIC)] != MAGIC[: len(data)] or not data:
        raise InputError(f"{path} is not a compact file of nrfgs: it begins with {data[:8]!r}. {fix}")
    if len(data) < PREAMBLE.size:
        raise InputError(f"{path} is cut short: {len(data)} bytes. {fix}")
    _, version, length, total = PREAMBLE.unpack_from(data)
    first = PREAMBLE.size + length + CHECKSUM.size
    # Another version may be laid out differently: its number comes before whether the file is whole.
    if version != VERSION:
        raise InputError(
            f"{path} is of version {version} of the format, and this program reads version {VERSION}. "
            f"{'Install a newer nrfgs-ns, or copy it again.' if version > VERSION else fix}"
        )
    if len(data) != total or len(data) < first:
        raise InputError(f"{path} has {len(data)} bytes, and its header says {total}. {fix}")
    header_end = first - CHECKSUM.size
    if zlib.crc32(data[:header_end]) != CHECKSUM.unpack_from(data, header_end)[0]:
        raise InputError(f"{path} is damaged: the header's checksum does not hold. {fix}")
    try:
        header = _header(data[PREAMBLE.size : header_end], max(LARGEST_RATIO * len(data), SMALL))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its header is none of a compact file ({error}). {fix}") from error
    streams = {}
    for entry in header["streams"]:
        body, first = data[first : first + entry["bytes"]], first + entry["bytes"]
        if len(body) != entry["bytes"] or zlib.crc32(body) != entry["crc32"]:
            raise InputError(f"{path} is damaged: the checksum of its stream {entry['name']!r} does not hold. {fix}")
        try:
            streams[entry["name"]] = (_uncoded if entry["coding"] == "rans" else _unpack)(entry, body)
        except (ValueError, lzma.LZMAError, struct.error) as error:  # made to mislead: the checksum holds
            raise InputError(f"{path}: its stream {entry['name']!r} cannot be decoded ({error}). {fix}") from error
    if first != len(data):
        raise InputError(f"{path} has {len(data) - first} bytes after its last stream. {fix}")
    return header, streams


def _header(text: bytes, most: int) -> dict[str, Any]:
    """The header; ValueError if a stream's entry is impossible, or all unpack to more than `most` bytes together."""
    header = json.loads(text)
    entries = header.get("streams") if isinstance(header, dict) else None
    if not isinstance(entries, list):
        raise ValueError("no list of streams")
    total = 0
    for entry in entries:
        named = f"the stream {ascii(entry)[:200]}"
        if not (isinstance(entry, dict) and all(_is(entry.get(key), kind) for key, kind in ENTRY.items())):
            raise ValueError(named)
        sizes, coding = entry["shape"], entry["coding"]
        possible = entry["dtype"] in CODINGS.get(coding, ()) and entry["bytes"] >= 0
        possible &= len(sizes) <= MOST_AXES and all(_is(size, int) and 0 <= size < 2**48 for size in sizes)
        if not possible or coding == "rans" and len(sizes) != 2:
            raise ValueError(named)
        total += math.prod(sizes) * np.dtype(entry["dtype"]).itemsize
        if total > most:
            raise ValueError(f"{named} would unpack to more than {most} bytes")
    if len({entry["name"] for entry in entries}) < len(entries):
        raise ValueError("two streams of one name")
    return header


def _is(value: Any, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _pack(raw: bytes) -> bytes:
    """Compressed without context: a quantised number's byte does not depend on the one beside it."""
    options = {"id": lzma.FILTER_LZMA2, "preset": 9, "lc": 0, "lp": 0, "pb": 0}
    options["dict_size"] = min(max(len(raw), 4096), LARGEST_DICTIONARY)
    return lzma.compress(raw, format=lzma.FORMAT_XZ, check=lzma.CHECK_NONE, filters=[options])


def _unpack(entry: Mapping[str, Any], body: bytes) -> np.ndarray:
    count, size = math.prod(entry["shape"]), np.dtype(entry["dtype"]).itemsize
    unpacker = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=LARGEST_MEMORY)
    raw = unpacker.decompress(body, max_length=count * size + 1) if body else b""
    if len(raw) != count * size:
        raise ValueError(f"it does not hold {count} numbers of {size} bytes")
    planes = np.frombuffer(raw, dtype=np.uint8).reshape(size, count)
    return np.ascontiguousarray(planes.T).view(np.dtype(entry["dtype"]).newbyteorder("<")).reshape(entry["shape"])


def _coded(table: Table) -> tuple[np.ndarray, bytes, str]:
    """A table in its narrowest type, its bytes, and how they are coded."""
    low, high = int(table.numbers.min(initial=0)), int(table.numbers.max(initial=0))
    dtype = "uint32" if not table.signed else "int16" if -(2**15) <= low and high < 2**15 else "int32"
    model, words = encode_table(table.numbers, table.signed)
    packed = _pack(_planes(model))
    return table.numbers.astype(dtype), MODEL.pack(len(model), len(packed)) + packed + words, "rans"


def _uncoded(entry: Mapping[str, Any], body: bytes) -> np.ndarray:
    columns, rows = entry["shape"]
    count, size = MODEL.unpack_from(body)
    if columns > MOST_COLUMNS or count > min(columns * MOST_MODEL, SMALL // 4):
        raise ValueError(f"a model of {count} numbers for {columns} columns is too large")
    model = _unpack({"shape": [count], "dtype": "int32"}, body[MODEL.size : MODEL.size + size])
    table = decode_table(model, body[MODEL.size + size :], columns, rows)
    bounds = np.iinfo(entry["dtype"])
    if table.size and not bounds.min <= table.min() <= table.max() <= bounds.max:
        raise ValueError(f"it holds numbers that are no {entry['dtype']}")
    return table.astype(entry["dtype"])


def _planes(array: np.ndarray) -> bytes:
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return np.ascontiguousarray(little.reshape(-1, 1).view(np.uint8).reshape(-1, little.dtype.itemsize).T).tobytes()
