# SPDX-License-Identifier: Apache-2.0
"""A data set of a few small images, for tests that break it, and any data set in another unit."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from nrfgs_ns.data.dataparser import NrfgsDataParserConfig


def listing(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of change of all that is in a folder."""
    return {path: (status.st_size, status.st_mtime_ns) for path in folder.rglob("*") for status in (path.lstat(),)}


class Capture:
    """A small data set on disk, to be broken in one way at a time: change `meta` or the files, then `parse`."""

    width, height = 12, 9

    def __init__(self, folder: Path, images: int):
        self.folder = folder
        self.rng = np.random.default_rng(0)
        (folder / "images").mkdir(parents=True)
        frames = []
        for i in reversed(range(images)):  # out of order: the split goes by sorted name
            name = f"images/{i:03d}.png"
            Image.fromarray(self.rng.integers(0, 256, (self.height, self.width, 3), dtype=np.uint8)).save(folder / name)
            frames.append({"file_path": name, "transform_matrix": self.pose(2 * np.pi * i / images).tolist()})
        intrinsics = {"fl_x": 10.0, "fl_y": 11.0, "cx": 6.0, "cy": 4.5}
        self.meta = {**intrinsics, "w": self.width, "h": self.height, "frames": frames}

    @staticmethod
    def pose(angle: float) -> np.ndarray:
        """Camera-to-world of a camera on a ring of radius 3 about (5, 6, 7), facing its centre; +z points backwards."""
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.stack([[-s, c, 0], [0, 0, 1], [c, s, 0]], axis=1)
        position = np.array([5.0, 6.0, 7.0]) + 3 * rotation[:, 2]
        return np.block([[rotation, position[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    def add_masks(self) -> None:
        (self.folder / "masks").mkdir()
        for frame in self.meta["frames"]:
            frame["mask_path"] = frame["file_path"].replace("images", "masks")
            pixels = self.rng.integers(0, 2, (self.height, self.width), dtype=np.uint8) * 255
            Image.fromarray(pixels).save(self.folder / frame["mask_path"])

    def add_ply(self, xyz: np.ndarray, rgb: np.ndarray | None = None, text: bool = False) -> Path:
        """Writes points.ply with the dtypes of the arrays, and names it."""
        columns = dict(zip("xyz", np.asarray(xyz).T, strict=True))
        if rgb is not None:
            columns |= dict(zip(("red", "green", "blue"), np.asarray(rgb).T, strict=True))
        vertices = np.rec.fromarrays(list(columns.values()), names=list(columns))
        path = self.folder / "points.ply"
        PlyData([PlyElement.describe(np.asarray(vertices), "vertex")], text=text).write(path)
        self.meta["ply_file_path"] = path.name
        return path

    def save(self) -> Path:
        path = self.folder / "transforms.json"
        path.write_text(json.dumps(self.meta))
        return path

    def parser(self, **options):
        self.save()
        return NrfgsDataParserConfig(**{"data": self.folder, **options}).setup()

    def parse(self, split: str = "train", **options):
        return self.parser(**options).get_dataparser_outputs(split)


def rescale(folder: Path, factor: float) -> None:
    """Measure a scene in another unit: every length in poses and points times `factor`."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    for frame in meta["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= factor
    path.write_text(json.dumps(meta))
    points = PlyData.read(str(folder / meta["ply_file_path"]), mmap=False)
    for axis in "xyz":
        points["vertex"][axis] *= factor
    points.write(str(folder / meta["ply_file_path"]))
