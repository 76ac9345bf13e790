# SPDX-License-Identifier: Apache-2.0
"""The CPU back end: `projection`, `tiles`, `compositing`, in this order. Their float64 twin lives with the tests."""

from .compositing import composite, leaves_out
from .projection import project

__all__ = ["composite", "leaves_out", "project"]
