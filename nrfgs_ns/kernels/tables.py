# SPDX-License-Identifier: Apache-2.0
"""Rows of tables [.., SIZE] in Triton's kernels, as a tuple of columns."""

import triton
import triton.language as tl


@triton.jit
def load_rows(table, rows, valid, SIZE: tl.constexpr):
    """Some rows of a table; 0 where they are not valid."""
    columns = ()
    for i in tl.static_range(SIZE):
        columns = columns + (tl.load(table + rows * SIZE + i, mask=valid, other=0.0),)
    return columns


@triton.jit
def store_rows(table, rows, columns, valid, SIZE: tl.constexpr):
    """Write some rows of a table where they are valid."""
    for i in tl.static_range(SIZE):
        tl.store(table + rows * SIZE + i, columns[i], mask=valid)
