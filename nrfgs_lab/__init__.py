# SPDX-License-Identifier: Apache-2.0
"""The laboratory: what this project's claims rest on. It imports the product, never the reverse."""
