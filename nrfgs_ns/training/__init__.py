# SPDX-License-Identifier: Apache-2.0
"""A training: its steps, what watches over them, what it saves."""
