# SPDX-License-Identifier: Apache-2.0
"""The colour stage: one head per file, all behind `head.AppearanceHead`."""
