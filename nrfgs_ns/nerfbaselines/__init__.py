# SPDX-License-Identifier: Apache-2.0
"""The methods for nerfbaselines: `spec.py` registers them, `method.py` is what it then builds, `photos.py` its data."""
