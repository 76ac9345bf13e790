# SPDX-License-Identifier: Apache-2.0
"""Choosing settings without looking at test views.

    python -m nrfgs_lab.held_out make SCENES OUT [OFFSET[/VIEWS]] [NAME ...]
    python -m nrfgs_lab.held_out report results/held-out.json
    python -m nrfgs_lab.held_out effects results/held-out.json
    python -m nrfgs_lab.held_out test-views results/captures.json

`make` writes, for captures with a transforms.json that names its split, data sets of their training views alone at half
the size, every eighth of which is held out as a test view (from the OFFSET-th on, 4 unless said otherwise); with VIEWS
so many of the others, evenly spaced, are left.
`report` prints the tables of docs/captures.md: each trial against the harmonics that were trained with the same
densification, steps and held-out views. `effects` prints what each factor of the screening designs does: sixteen
trainings a capture that turn nine factors on and off in a balanced way say as much of each factor as if it alone had
been turned. `test-views` prints what trainings at full size have on test views.
"""

import json
import shutil
import sys
from collections import defaultdict
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
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


# Reports.


def against_harmonics(records: list[dict[str, Any]]) -> dict[str, dict[str, tuple[float, float, int]]]:
    """What each trial gains over the harmonics of its group.

    Args:
        records: with "trial", "group" (densification and steps), "baseline" (true of the group's harmonics), "scene",
            "offset" and "per_image" (lists of name, PSNR, SSIM, MS-SSIM).

    Returns:
        group, offset and trial -> scene -> median over views of the gain in PSNR, mean gain in SSIM, and the number of
        views.
    """
    harmonics = {
        (one["group"], one["scene"], one["offset"]): {view[0]: view for view in one["per_image"]}
        for one in records
        if one["baseline"]
    }
    gains: dict[str, dict[str, list]] = defaultdict(lambda: defaultdict(list))
    for one in records:
        base = harmonics.get((one["group"], one["scene"], one["offset"]))
        for name, psnr, ssim, *_ in one["per_image"] if base else ():
            gains[f"{one['group']}, from {one['offset']}: {one['trial']}"][one["scene"]].append(
                (psnr - base[name][1], ssim - base[name][2])
            )
    return {
        trial: {
            scene: (median(psnr for psnr, _ in views), mean(ssim for _, ssim in views), len(views))
            for scene, views in by_scene.items()
        }
        for trial, by_scene in gains.items()
    }


def report(file: Path) -> str:
    """The records as two tables: means over views, and gains over harmonics."""
    records = list(json.loads(file.read_text(encoding="utf-8"))["records"].values())
    scenes = sorted({one["scene"] for one in records})
    groups: dict[str, dict[str, list]] = defaultdict(lambda: defaultdict(list))
    for one in records:
        groups[f"{one['group']}, from {one['offset']}: {one['trial']}"][one["scene"]].append(one)
    lines = [f"| PSNR / SSIM | {' | '.join(scenes)} |", "|---" * (len(scenes) + 1) + "|"]
    for name, by_scene in sorted(groups.items()):
        cells = [
            f"{mean(one['psnr'] for one in by_scene[scene]):.2f} / {mean(one['ssim'] for one in by_scene[scene]):.3f}"
            if scene in by_scene
            else ""
            for scene in scenes
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"| gain over harmonics, dB / 1000 SSIM | {' | '.join(scenes)} |", "|---" * (len(scenes) + 1) + "|"]
    for trial, by_scene in sorted(against_harmonics(records).items()):
        cells = [
            f"{by_scene[scene][0]:+.2f} / {1000 * by_scene[scene][1]:+.0f}" if scene in by_scene else ""
            for scene in scenes
        ]
        lines.append(f"| {trial} | {' | '.join(cells)} |")
    return "\n".join(lines)


RUNS = 16
"""Trainings of a screening of one head on one capture."""
TELLING = 0.7
"""dB that a held-out view may differ from what is expected before it counts less: one that fails would decide all."""


def effects(records: list[dict[str, Any]]) -> dict[str, tuple[float, float]]:
    """What each factor does to held-out views: least squares with a level for each view and an effect for each factor.

    Args:
        records: of one head, with "factors" (names of those that are on), "scene", "offset" and "per_image".

    Returns:
        factor -> its effect on PSNR in dB (errors beyond `TELLING` count by their length, not by their square: Huber)
        and on SSIM.
    """
    factors = sorted({factor for one in records for factor in one["factors"]})
    views = sorted({(one["scene"], one["offset"], view[0]) for one in records for view in one["per_image"]})
    place = {view: len(factors) + number for number, view in enumerate(views)}
    rows, values = [], []
    for one in records:
        for name, psnr, ssim, *_ in one["per_image"]:
            row = np.zeros(len(factors) + len(views))
            row[: len(factors)] = [factor in one["factors"] for factor in factors]
            row[place[one["scene"], one["offset"], name]] = 1.0
            rows.append(row)
            values.append((psnr, ssim))
    design, (psnr, ssim) = np.array(rows), np.array(values).T
    weights = np.ones(len(psnr))
    for _ in range(50):
        solution = np.linalg.lstsq(design * weights[:, None], psnr * weights, rcond=None)[0]
        weights = np.sqrt(TELLING / np.maximum(np.abs(psnr - design @ solution), TELLING))
    of_ssim = np.linalg.lstsq(design, ssim, rcond=None)[0]
    return {name: (solution[number], of_ssim[number]) for number, name in enumerate(factors)}


def screening(file: Path) -> str:
    """What each factor of the screening does, for each head and capture that has all its trainings."""
    groups: dict[tuple[str, str], list] = defaultdict(list)
    for one in json.loads(file.read_text(encoding="utf-8"))["records"].values():
        if one.get("study") == "screening":
            groups[one["head"], one["scene"]].append(one)
    lines = []
    for (head, scene), runs in sorted(groups.items()):
        if len(runs) >= RUNS:
            lines.append(f"{head}, {scene}, {len(runs)} trainings: effect in dB, in SSIM x 1000")
            lines += [f"  {name:28s} {psnr:+.2f} {1000 * ssim:+.1f}" for name, (psnr, ssim) in effects(runs).items()]
    return "\n".join(lines)


METRICS = {"psnr": ".2f", "ssim": ".4f", "ms_ssim": ".4f", "flip": ".4f", "train_psnr": ".2f"}
"""What `test-views` prints, and how."""


def test_views(file: Path) -> str:
    """A table of what was measured on test views: means over seeds.

    Args:
        file: a study's, whose records have "scene", "name", "seed", "made_steps", "splats" and the metrics; "flip" is
            a list over views, or missing.
    """
    records = [one for one in json.loads(file.read_text(encoding="utf-8"))["records"].values() if "psnr" in one]
    rows: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for one in records:
        rows[one["scene"], one["name"]].append(one)
    lines = ["| scene | | seeds | steps | splats | PSNR | SSIM | MS-SSIM | FLIP | PSNR on training views |"]
    lines.append("|---" * 10 + "|")
    for (scene, name), seeds in sorted(rows.items()):
        cells = [scene, name, str(len(seeds)), f"{seeds[0]['made_steps']:,}"]
        cells.append(f"{round(mean(one['splats'] for one in seeds)):,}")
        for metric, form in METRICS.items():
            values = [one[metric] for one in seeds if one.get(metric)]
            cells.append(format(mean(mean(v) if isinstance(v, list) else v for v in values), form) if values else "-")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    verb, *words = sys.argv[1:]
    if verb == "make":
        first, _, kept = (words[2] if len(words) > 2 else "4").partition("/")
        make(Path(words[0]), Path(words[1]), int(first), words[3:] or None, int(kept) if kept else None)
    else:
        print({"report": report, "effects": screening, "test-views": test_views}[verb](Path(words[0])))
