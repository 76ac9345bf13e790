# SPDX-License-Identifier: Apache-2.0
"""Images compared: the training's SSIM, and the metrics of an evaluation."""
