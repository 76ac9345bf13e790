# SPDX-License-Identifier: Apache-2.0
"""What a scene does not need: which residuals nobody would miss, and how small a field can be."""
