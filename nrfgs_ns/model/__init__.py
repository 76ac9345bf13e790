# SPDX-License-Identifier: Apache-2.0
"""The model: nerfstudio's hooks, rendering, the loss, checkpoints."""
