# SPDX-License-Identifier: Apache-2.0
"""In open3d's place while tests run: nothing of ours may need it."""

raise ImportError("open3d is hidden from the tests, because it does not import on a Linux machine without libusb-1.0")
