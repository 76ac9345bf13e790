# SPDX-License-Identifier: Apache-2.0
"""Data parsers of a benchmark: every 8th image by name is a test image.

- `transforms.json`: `nrfgs-data`, with the data set's own split if it names one.
- A COLMAP model: nerfstudio's `colmap`. It counts images in the order of COLMAP's numbers, so the folder is mirrored by
  links into the work folder, beside lists of the names of each split.
- Held out: a data set, in the work folder, of the training views alone at half the size, some of them for testing.
- Fewer views: the capture with its own test views and some of its training views.
- A smaller size that the capture has no images of: they are made, since other projects' methods only read them.
"""

import contextlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from PIL import Image

from nrfgs_lab.bench.spec import Scene
from nrfgs_ns.data.checks import find_colmap
from nrfgs_ns.data.colmap import read_frames
from nrfgs_ns.data.pictures import read_mask, read_picture
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole, write_whole

TEST_EVERY = 8
QUALITY = 92
"""Quality of the JPEGs of held-out data sets."""


def parser_options(root: Path, scene: Scene, mirrors: Path) -> list[str]:
    """Name and options of the data parser, the last words of ns-train's command line.

    Mirrored and held-out data sets are written below `mirrors`. InputError for another layout, or missing images.
    """
    folder = root / scene.path
    mirror = mirrors / scene.name.replace("/", ", ")  # a folder in a mirror may be a link
    scale = [] if scene.downscale is None else ["--downscale-factor", str(scene.downscale)]
    if scene.held_out is not None or scene.views is not None:
        with FileLock(mirror.with_name(f"{mirror.name}.lock")):
            if not mirrors_already(mirror, folder):
                select_views(folder, mirror, scene)
            write_smaller(mirror, mirror, scene.downscale)
        return ["nrfgs-data", "--data", str(mirror), *scale, *scene.options]
    if (folder / "transforms.json").is_file():
        named = any(f"{split}_filenames" in transforms_of(folder) for split in ("train", "val", "test"))
        split = [] if named else ["--eval-mode", "interval"]
        if scene.downscale is not None:
            mirror = mirror.with_name(f"{mirror.name} in {scene.downscale}")
            with FileLock(mirror.with_name(f"{mirror.name}.lock")):
                mirrors_already(mirror, folder)
                folder = write_smaller(folder, mirror, scene.downscale)
        return ["nrfgs-data", "--data", str(folder), *split, *scale, *scene.options]
    model = find_colmap(folder)
    if model is None:
        raise InputError(f"{folder} has neither transforms.json nor a COLMAP model. Name a folder that has one.")
    smaller = folder / f"images_{scene.downscale}"
    if scene.downscale and not smaller.is_dir():
        raise InputError(f"{smaller} is missing. Downscale the images into it, or choose a factor that is there.")
    mirror_with_split(folder, model, mirror)
    parser = ["colmap", "--data", str(mirror), "--colmap-path", model, "--downscale-factor", str(scene.downscale or 1)]
    return [*parser, *scene.options]


def mirrors_already(mirror: Path, folder: Path) -> bool:
    """Whether there is a whole mirror of this folder and its transforms.json; any other, or part of one, is removed."""
    note = mirror / "mirror-of"
    file = folder / "transforms.json"
    here = f"{folder.resolve()}, {file.stat().st_mtime_ns if file.is_file() else 0}"
    whole_one = note.is_file() and note.read_text(encoding="utf-8") == here and (mirror / "transforms.json").exists()
    if not whole_one:
        shutil.rmtree(mirror, ignore_errors=True)
        write_whole(note, here)
    return whole_one


def held_out_views(names: list[str], first: int, every: int = TEST_EVERY) -> list[str]:
    """Views to hold out: by default every 8th, or every 6th of fewer than 30 if every 8th gives fewer than three."""
    chosen = names[first::every]
    return names[first::6] if every == TEST_EVERY and len(names) < 30 and len(chosen) < 3 else chosen


def by_place(names: list[str], frames: list[dict]) -> list[str]:
    """Views in the order of their cameras along the longest axis of all their places."""
    poses = {frame["file_path"]: frame["transform_matrix"] for frame in frames}
    places = np.array([poses[name] for name in names])[:, :3, 3]
    places = places - places.mean(axis=0)
    return [names[i] for i in np.argsort(places @ np.linalg.svd(places)[2][0], kind="stable")]


def select_views(folder: Path, out: Path, scene: Scene) -> None:
    """Write a data set of a capture's training views at half the size, some of them held out, or of the whole capture
    with fewer training views, into `out`. InputError if it has too few, or photographs elsewhere to be halved."""
    file = folder / "transforms.json"
    meta = transforms_of(folder)
    if not any(key.endswith("_filenames") for key in meta):  # `nrfgs bench` tests every 8th from the first, then
        every = sorted(frame["file_path"] for frame in meta.get("frames", ()))
        test = every[::TEST_EVERY]
        meta |= {"train_filenames": [n for n in every if n not in test], "val_filenames": test, "test_filenames": test}
    if not meta.get("train_filenames"):
        raise InputError(f"{file} is missing, or has too few training views. Give a capture that nrfgs prepare wrote.")
    names = sorted(meta["train_filenames"])
    if scene.held_out is None:
        for entry in {*folder.iterdir()} - {file}:
            (out / entry.name).symlink_to(entry.resolve())
    else:
        frames = [frame for frame in meta["frames"] if frame["file_path"] in names]
        files = [Path(frame[key]) for frame in frames for key in ("file_path", "mask_path") if key in frame]
        if any(name.is_absolute() or ".." in name.parts for name in files):  # which halves would replace
            raise InputError(f"{file} names photographs elsewhere. Give a capture that nrfgs prepare wrote.")
        meta |= {"frames": sorted(frames, key=lambda frame: frame["file_path"])}
        _halve(meta, folder, out)
        if scene.held_out_by == "place":
            names = by_place(names, meta["frames"])
            blocks = np.array_split(names, scene.held_out_every)
            test = blocks[scene.held_out].tolist() if scene.held_out < len(blocks) else []
        else:
            test = held_out_views(names, scene.held_out, scene.held_out_every)
        if not test:
            raise InputError(f"held_out: {scene.held_out} holds out none of the {len(names)} views of {file}.")
        names = [name for name in names if name not in test]
        meta |= {"test_filenames": test, "val_filenames": test}
    meta["train_filenames"] = [names[i] for i in evenly_spaced(len(names), scene.views or len(names))]
    write_whole(out / "transforms.json", json.dumps(meta, indent=1))


def _halve(meta: dict, folder: Path, out: Path) -> None:
    """Halve the frames' images and their cameras."""
    for frame in meta["frames"]:
        size = [{**frame, **meta}[side] // 2 for side in ("w", "h")]
        for key in {"file_path", "mask_path"} & frame.keys():
            target = out / frame[key]
            target.parent.mkdir(parents=True, exist_ok=True)
            with Image.open(folder / frame[key]) as picture:
                small = picture.convert("RGB" if key == "file_path" else "L").resize(size, Image.Resampling.BOX)
                small.save(target, quality=QUALITY)
    for lens in [meta] if "w" in meta else meta["frames"]:
        for side, keys in (("w", ("fl_x", "cx")), ("h", ("fl_y", "cy"))):
            half = lens[side] // 2
            lens |= {**{key: lens[key] * (half / lens[side]) for key in keys}, side: half}
    if "ply_file_path" in meta:
        shutil.copy(folder / meta["ply_file_path"], out / meta["ply_file_path"])


def write_smaller(folder: Path, mirror: Path, downscale: int | None) -> Path:
    """The folder of a data set with images at a smaller size: `folder` if it has them or needs none, else `mirror`, in
    which they are written as `nrfgs-data` would resize them, beside links to the rest. A data set that `nrfgs-data`
    refuses is left to it."""
    smaller = folder / f"images_{downscale}"
    if downscale is None or smaller.is_symlink() or (folder != mirror and smaller.is_dir()):
        return folder
    frames = transforms_of(folder).get("frames", [])
    names = {key: [frame[key] for frame in frames if key in frame] for key in ("file_path", "mask_path")}
    if not frames or any(len({Path(name).name for name in of_kind}) < len(set(of_kind)) for of_kind in names.values()):
        return folder
    mirror.mkdir(parents=True, exist_ok=True)
    for entry in folder.iterdir():
        if not (mirror / entry.name).exists():
            (mirror / entry.name).symlink_to(entry.resolve())
    kinds = ("file_path", "images", read_picture, "LANCZOS"), ("mask_path", "masks", read_mask, "NEAREST")
    for key, kind, read, sampling in kinds:
        for name in names[key]:
            target = mirror / f"{kind}_{downscale}" / Path(name).name
            if not target.exists():
                picture = read(folder / name)
                small = picture.resize([side // downscale for side in picture.size], Image.Resampling[sampling])
                with Image.open(folder / name) as original, whole(target) as aside:
                    small.save(aside, "PNG", exif=original.getexif())  # lossless, whatever the name says
    return mirror


def transforms_of(folder: Path) -> dict[str, Any]:
    """The content of transforms.json; empty where it cannot be read, which the data parser refuses."""
    with contextlib.suppress(OSError, ValueError):
        content = json.loads((folder / "transforms.json").read_bytes())
        return content if isinstance(content, dict) else {}
    return {}


def mirror_with_split(folder: Path, model: str, mirror: Path) -> None:
    """Link the content of `folder` into `mirror`, beside lists of training and test images; replace links elsewhere."""
    names = sorted(frame["file_path"] for frame in read_frames(folder / model)[0])
    if len(names) < 2:
        raise InputError(f"{folder / model} has {len(names)} images; one to train on and one to test are needed.")
    mirror.mkdir(parents=True, exist_ok=True)
    test = names[::TEST_EVERY]
    lists = {"train": sorted(set(names) - set(test)), "val": test, "test": test}
    targets = {entry.name: entry.resolve() for entry in folder.iterdir()}
    for name in [f"{split}_list.txt" for split in lists]:
        targets.pop(name, None)
    for name, target in targets.items():
        link = mirror / name
        if not link.is_symlink() or link.readlink() != target:
            with whole(link) as aside:
                aside.symlink_to(target, target_is_directory=target.is_dir())
    for split, members in lists.items():
        write_whole(mirror / f"{split}_list.txt", "".join(f"{name}\n" for name in members))
