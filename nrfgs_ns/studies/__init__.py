# SPDX-License-Identifier: Apache-2.0
"""What the claims rest on. Nothing outside this folder and the command line imports it."""
