# SPDX-License-Identifier: Apache-2.0
"""Photographs or a video to a posed scene.

`photos` collects them, `pairs` chooses those to match, `structure` finds the cameras, `scene` writes the data set,
`command` runs one after the other. pycolmap does the geometry. Nothing here needs a COLMAP program, ffmpeg or a GPU.
"""
