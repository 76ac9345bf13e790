# SPDX-License-Identifier: Apache-2.0
"""Data sets for choosing settings without looking at test views.

    python -m nrfgs_lab.held_out make SCENES OUT [OFFSET[/VIEWS]] [NAME ...]

writes, for captures with a transforms.json that names its split, data sets of their training views alone at half the
size, every eighth of which is held out as a test view (from the OFFSET-th on, 4 unless said otherwise); with VIEWS so
many of the others, evenly spaced, are left.
"""

import json
import shutil
import sys
from pathlib import Path

from PIL import Image

from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.errors import InputError

EVERY = 8
"""One training view of so many is held out; of fewer than 30 views one of six, if that leaves fewer than three."""
QUALITY = 92
"""Of the JPEGs written."""


def held_out(names: list[str], offset: int) -> list[str]:
    """Which of the training views are held out."""
    chosen = names[offset::EVERY]
    return names[offset::6] if len(names) < 30 and len(chosen) < 3 else chosen


def make(scenes: Path, out: Path, offset: int = 4, names: list[str] | None = None, views: int | None = None) -> None:
    """Write the data sets.

    Args:
        scenes: folder of captures.
        out: folder for theirs.
        offset: first of the held-out views among the training views in the order of their names.
        names: captures; None for all.
        views: how many of the others stay training views; None: all.

    Raises:
        InputError: a capture names no training views.
    """
    for file in sorted(scenes.glob("*/transforms.json")):
        if names and file.parent.name not in names:
            continue
        _make_one(file, out / file.parent.name, offset, views)


def _make_one(file: Path, out: Path, offset: int, views: int | None) -> None:
    meta = json.loads(file.read_text(encoding="utf-8"))
    if not meta.get("train_filenames"):
        raise InputError(f"{file} has no train_filenames. Write a capture that names its split (nrfgs prepare does).")
    training = set(meta["train_filenames"])
    frames = sorted((one for one in meta["frames"] if one["file_path"] in training), key=lambda one: one["file_path"])
    size = meta["w"] // 2, meta["h"] // 2
    for frame in frames:
        for key in {"file_path", "mask_path"} & frame.keys():
            target = out / frame[key]
            target.parent.mkdir(parents=True, exist_ok=True)
            with Image.open(file.parent / frame[key]) as picture:
                small = picture.convert("RGB" if key == "file_path" else "L").resize(size, Image.Resampling.BOX)
                small.save(target, quality=QUALITY)
    aside = held_out([frame["file_path"] for frame in frames], offset)
    across, down = size[0] / meta["w"], size[1] / meta["h"]
    meta |= {name: meta[name] * across for name in ("fl_x", "cx")} | {
        name: meta[name] * down for name in ("fl_y", "cy")
    }
    meta |= {"w": size[0], "h": size[1], "frames": frames, "test_filenames": aside, "val_filenames": aside}
    left = [frame["file_path"] for frame in frames if frame["file_path"] not in aside]
    meta["train_filenames"] = [left[i] for i in evenly_spaced(len(left), views or len(left))]
    (out / "transforms.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")
    if "ply_file_path" in meta:
        shutil.copy(file.parent / meta["ply_file_path"], out / meta["ply_file_path"])


if __name__ == "__main__":
    if sys.argv[1:2] != ["make"] or len(sys.argv) < 4:
        sys.exit(__doc__)
    first, _, kept = (sys.argv[4] if len(sys.argv) > 4 else "4").partition("/")
    make(Path(sys.argv[2]), Path(sys.argv[3]), int(first), sys.argv[5:] or None, int(kept) if kept else None)
