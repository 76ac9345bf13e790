# SPDX-License-Identifier: Apache-2.0
"""Photographs or a video to a posed scene.

`photos` collects them, `structure` finds the cameras, `scene` writes the data set, `verb` runs one after the other.
pycolmap does the geometry. Nothing here needs a COLMAP program, ffmpeg or a GPU.
"""
