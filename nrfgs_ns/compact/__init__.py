# SPDX-License-Identifier: Apache-2.0
"""A trained field in a small file: `format.py` is the container, `quantise.py` turns tables into whole numbers,
`encode.py` and `decode.py` go from a field to a file and back.

To read a file without this code: `format.py` describes the container, `encode.py` header and streams, `entropy.py` the
coding of tables, `nrfgs_lab/compact_1.py` version 1.
"""
