# SPDX-License-Identifier: Apache-2.0
"""The methods for nerfbaselines, which compares methods under one protocol (docs/bench.md)."""
