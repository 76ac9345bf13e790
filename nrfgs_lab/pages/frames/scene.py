# SPDX-License-Identifier: Apache-2.0
"""A made scene of discs, its PLY file, and the cameras around it: numpy alone, so that it can be made anywhere.

As nrfgs_lab.timing.scale.made: thin discs on a bumpy ball (half of them) and two walls around it and the cameras.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np

STEP = 0.02  # radians between pictures, as `nrfgs.measure`
FOCAL = 0.87  # widths of a picture
CAMERAS = 160
SIZE = (1920, 1080)
PLY = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)),
       "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def splats(count: int) -> dict[str, np.ndarray]:
    """In nerfstudio's world (z up): means, scales (logarithms), quats (w first), opacities (logits), features_dc."""
    draw = np.random.default_rng(0)
    normals, spread, colors = draw.standard_normal((3, count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = np.float32([0.5] * 5 + [2.0] * 3 + [5.0] * 2)[np.arange(count) * 10 // count, None]
    means = radii * normals * (1 + 0.1 * np.sin(9 * normals).prod(axis=1, keepdims=True))
    scales = np.log(radii * (12 / count) ** 0.5) + 0.5 * spread - np.float32([0.4, 0.4, 2.5])
    quats = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], axis=1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True).clip(1e-9)
    logits = (2 * draw.standard_normal((count, 1))).clip(-5, 5)
    made = {"means": means, "scales": scales, "quats": quats, "opacities": logits, "features_dc": colors}
    return {name: value.astype(np.float32) for name, value in made.items()}


def write_ply(path: Path, count: int) -> None:
    """The splats with random harmonics of degree 3, in the world of 3DGS's viewers (y down)."""
    s, draw = splats(count), np.random.default_rng(1)
    x, y, z = s["means"].T
    w, a, b, c = s["quats"].T  # (cos 45, sin 45, 0, 0) times it
    table = np.zeros((count, 62), "<f4")
    table[:, :3] = np.stack([x, -z, y], axis=1)
    table[:, 6:9], table[:, 9:54] = s["features_dc"], 0.05 * draw.standard_normal((count, 45), dtype=np.float32)
    table[:, 54:55], table[:, 55:58] = s["opacities"], s["scales"]
    table[:, 58:] = np.stack([w - a, a + w, b - c, c + b], axis=1) * 0.5**0.5
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    header += "".join(f"property float {name}\n" for name in PLY) + "end_header\n"
    path.write_bytes(header.encode() + table.tobytes())


def eyes() -> list[list[float]]:
    """Places of the cameras, which look at the origin, in nerfstudio's world."""
    return [[1.4 * math.cos(STEP * k), -1.4 * math.sin(STEP * k), 0.55] for k in range(CAMERAS)]


def write_cameras(folder: Path) -> None:
    """cameras.json for Spark and for driving the page; settings.json for SuperSplat's viewer."""
    width, height = SIZE
    across, down = (math.degrees(2 * math.atan(side / 2 / (FOCAL * width))) for side in (width, height))
    around = {"fov": down, "eyes": [[x, z, -y] for x, y, z in eyes()], "ours": eyes()}
    (folder / "cameras.json").write_text(json.dumps(around))
    keys = {"position": [value for x, y, z in eyes() for value in (-x, z, y)], "target": [0] * 3 * CAMERAS}
    track = {"name": "around", "duration": CAMERAS, "frameRate": 1, "target": "camera", "loopMode": "none"}
    track |= {"interpolation": "spline", "keyframes": {"times": list(range(CAMERAS)), "values": keys}}
    settings = {"camera": {"fov": across, "startAnim": "animTrack"}, "background": {}, "animTracks": [track]}
    (folder / "settings.json").write_text(json.dumps(settings))


if __name__ == "__main__":
    folder, count = Path(sys.argv[1]), int(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / "scene.ply", count)
    write_cameras(folder)
