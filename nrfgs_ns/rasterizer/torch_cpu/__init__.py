# SPDX-License-Identifier: Apache-2.0
"""The CPU back end: `projection`, `tiles`, `compositing`. Their float64 twin lives with the tests."""
