# SPDX-License-Identifier: Apache-2.0
"""How a Triton kernel is tried and given up, once for all kernels."""
