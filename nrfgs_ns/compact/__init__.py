# SPDX-License-Identifier: Apache-2.0
"""A trained field in a small file: `format.py` is the container, `quantise.py` turns tables into whole numbers,
`encode.py` and `decode.py` go from a field to a file and back.

docs/compact-format.md describes the file for those who want to read it without this code.
"""
