# SPDX-License-Identifier: Apache-2.0
"""A trained field in a small file: `format.py` is the container, `quantise.py` turns tables into whole numbers,
`encode.py` and `decode.py` go from a field to a file and back.

The docstrings of `format.py`, `encode.py`, `tables.py` and `entropy.py` are the specification.
"""
