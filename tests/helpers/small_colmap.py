# SPDX-License-Identifier: Apache-2.0
"""A COLMAP model of ten cameras on a ring, for tests that break it."""

import struct
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from small_capture import Capture

MODEL = Path("colmap/sparse/0")
FILES = ("cameras", "images", "points3D")


class Model:
    """Ten cameras on a ring and forty points, to be changed before they are written."""

    def __init__(self) -> None:
        self.cameras = [(1, 1, 12, 9, (10.0, 11.0, 6.0, 4.5))]
        self.images = []
        for i in range(10):
            world_to_camera = np.linalg.inv(Capture.pose(2 * np.pi * i / 10) * [1, -1, -1, 1])
            x, y, z, w = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat()
            self.images.append((i + 1, (w, x, y, z), tuple(world_to_camera[:3, 3]), 1, f"{i:03d}.png"))
        rng = np.random.default_rng(1)
        self.points = [(i, tuple(xyz), (9, 99, 199)) for i, xyz in enumerate(rng.normal((5, 6, 7), 0.5, (40, 3)))]
        self.tracks = 2
        self.counts = {}

    def binary(self) -> dict[str, bytes]:
        cameras = [struct.pack(f"<iiQQ{len(p)}d", i, m, w, h, *p) for i, m, w, h, p in self.cameras]
        feature, track = struct.pack("<Qddq", 1, 3.0, 4.0, -1), struct.pack("<iiii", 1, 0, 2, 0)
        images = [
            struct.pack("<i7di", i, *q, *t, c) + name.encode("utf-8", "surrogatepass") + b"\0" + feature
            for i, q, t, c, name in self.images
        ]
        points = [struct.pack("<Q3d3BdQ", i, *xyz, *rgb, 0.5, self.tracks) + track for i, xyz, rgb in self.points]
        return {
            file: struct.pack("<Q", self.counts.get(file, len(rows))) + b"".join(rows)
            for file, rows in zip(FILES, (cameras, images, points), strict=True)
        }

    def text(self) -> dict[str, bytes]:
        names = {1: "PINHOLE", 6: "FULL_OPENCV"}

        def line(*words) -> str:
            return " ".join(map(str, words)) + "\n"

        cameras = "".join(line(i, names.get(m, m), w, h, *p) for i, m, w, h, p in self.cameras)
        images = "".join(line(i, *q, *t, c, name) + line(3.0, 4.0, -1) for i, q, t, c, name in self.images)
        points = "".join(line(i, *xyz, *rgb, 0.5, 1, 0, 2, 0) for i, xyz, rgb in self.points)
        return {file: f"# {file}\n{rows}".encode() for file, rows in zip(FILES, (cameras, images, points), strict=True)}

    def write(self, folder: Path, text: bool = False) -> Path:
        (folder / MODEL).mkdir(parents=True)
        (folder / "images").mkdir()
        for file, content in (self.text() if text else self.binary()).items():
            (folder / MODEL / f"{file}.{'txt' if text else 'bin'}").write_bytes(content)
        rng = np.random.default_rng(0)
        for i in range(10):
            Image.fromarray(rng.integers(0, 256, (9, 12, 3), dtype=np.uint8)).save(folder / "images" / f"{i:03d}.png")
        return folder
