# SPDX-License-Identifier: Apache-2.0
"""Nerfstudio's viewer: pictures of a head, the panel that chooses among them, and a guarded server."""
