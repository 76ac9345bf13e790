# SPDX-License-Identifier: Apache-2.0
"""Coded tables: what goes in comes out, in Python and in the page's JavaScript; what is damaged is refused."""

import hashlib
import shutil

import numpy as np
import pytest
from compact_fields import in_node, write_container
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.compact.entropy import BadStream, decode_table, encode_table
from nrfgs_ns.compact.format import Table


def laplacian(columns: int, rows: int, scale: float = 5.0, seed: int = 0) -> np.ndarray:
    """Columns that follow their neighbours, and each other."""
    steps = np.random.default_rng(seed).laplace(size=(columns, rows)) * scale * (1 + np.sin(np.arange(rows) / 50))
    return np.rint(steps + 0.8 * np.roll(steps, 1, axis=0) + np.cumsum(steps, axis=1) * 0.2).astype(np.int64)


TABLES = {
    "none": (np.zeros((3, 0)), True),
    "no columns": (np.zeros((0, 7)), True),
    "one": (np.array([[-7]]), True),
    "constant": (np.full((2, 5000), 3), True),
    "small": (laplacian(3, 17), True),
    "lanes of unequal length": (laplacian(11, 4099), True),
    "large": (laplacian(1, 3000, 1e6), True),
    "largest": (np.array([[2**31 - 1, -(2**31), 0, 2**31 - 1, -(2**31)]]), True),
    "unsigned": (np.random.default_rng(1).integers(0, 2**32, (2, 2500)), False),
    "unsigned and small": (np.random.default_rng(2).integers(0, 3, (2, 2500)), False),
}


@pytest.mark.parametrize("name", TABLES)
def test_what_goes_in_comes_out(name):
    table, signed = TABLES[name]
    model, data = encode_table(table, signed)
    found = decode_table(model, data, *table.shape)
    assert found.shape == table.shape and (found == table).all()


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


def test_it_takes_what_entropy_says():
    """Independent numbers cannot take less than their entropy; this takes 1 % more, and a model."""
    table = np.rint(np.random.default_rng(3).laplace(size=(4, 50_000)) * 3).astype(np.int64)
    model, data = encode_table(table)
    _, counts = np.unique(table, return_counts=True)
    entropy = -(counts * np.log2(counts / counts.sum())).sum() / 8
    assert entropy * 0.999 < len(data) < entropy * 1.01
    assert len(model) < 2000


def test_neighbours_are_worth_something():
    table = laplacian(3, 30_000)
    shuffled = table[:, np.random.default_rng(0).permutation(30_000)]
    assert len(encode_table(table)[1]) < 0.8 * len(encode_table(shuffled)[1])


SMALL = encode_table(laplacian(2, 200))


@settings(max_examples=200)
@given(st.data())
def test_a_changed_byte_is_refused_or_gives_numbers(data):
    """Without a checksum in front of it: whatever it is given, it ends, with numbers or with BadStream."""
    model, stream = SMALL
    if data.draw(st.booleans()):
        stream = bytearray(stream)
        stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(st.integers(1, 255))
    else:
        model = model.copy()
        model[data.draw(st.integers(0, len(model) - 1))] = data.draw(st.integers(-(2**31), 2**31 - 1))
    try:
        assert decode_table(model, bytes(stream), 2, 200).shape == (2, 200)
    except BadStream:
        pass


@pytest.mark.parametrize("columns, rows", [(2, 199), (2, 201), (1, 200), (3, 200), (2, 10_000)])
def test_another_shape_is_refused(columns, rows):
    with pytest.raises(BadStream):
        decode_table(*SMALL, columns, rows)


@pytest.mark.skipif(shutil.which("node") is None, reason="no node: the page's reader is tried by pytest -m browser")
def test_the_pages_reader_finds_the_same_numbers(tmp_path):
    tables = {name: Table(table, signed) for name, (table, signed) in TABLES.items()}
    write_container(tmp_path / "tables.nrf", {}, {**tables, "plain": np.arange(5, dtype=np.uint16)})
    for name, found in in_node(READ, tmp_path, "tables.nrf").items():
        table, signed = TABLES[name]
        assert found == hashlib.sha256(table.astype("<i4" if signed else "<u4").tobytes()).hexdigest(), name


READ = """
const fs = require("fs"), crypto = require("crypto");
const { streams } = readContainer(new Uint8Array(fs.readFileSync(process.argv[2])), () => {});
const found = {};
for (const [name, { columns }] of streams) {
  if (!columns) continue;
  const hash = crypto.createHash("sha256");
  for (const column of columns) hash.update(new Uint8Array(column.buffer));
  found[name] = hash.digest("hex");
}
console.log(JSON.stringify(found));
"""
