# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path

from plyfile import PlyData


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
