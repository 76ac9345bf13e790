# SPDX-License-Identifier: Apache-2.0
"""The model: nerfstudio's hooks, how a camera is rendered, the loss, what a checkpoint holds."""
