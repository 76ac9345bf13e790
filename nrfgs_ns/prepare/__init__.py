# SPDX-License-Identifier: Apache-2.0
"""Photographs or a video to a posed scene.

`photos` collects them, `pairs` says which may show the same thing, `structure` finds the cameras, `scene` writes the
data set, `command` runs one after the other and tells how long it will take (`forecast`).
pycolmap does the geometry. Nothing here needs a COLMAP program, ffmpeg or a GPU.
"""
