# SPDX-License-Identifier: Apache-2.0
"""A trained field in a small file, which `format.py`, `encode.py`, `tables.py` and `entropy.py` specify."""
