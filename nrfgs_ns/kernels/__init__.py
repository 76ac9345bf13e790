# SPDX-License-Identifier: Apache-2.0
"""How a Triton kernel is tried and given up, and reads its tables, once for all kernels."""
