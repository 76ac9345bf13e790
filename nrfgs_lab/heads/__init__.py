# SPDX-License-Identifier: Apache-2.0
"""Heads for comparison whose network sees pixels: the splats' features are composited, and their image decoded."""
