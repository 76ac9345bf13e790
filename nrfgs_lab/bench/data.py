# SPDX-License-Identifier: Apache-2.0
"""Data parsers of a benchmark: every 8th image by name is a test image.

- `transforms.json`: `nrfgs-data`, with the data set's own split if it names one.
- `sparse/0` (or `colmap/sparse/0`, or `sparse`): nerfstudio's `colmap`. It counts images in the order of COLMAP's
  numbers, so the folder is mirrored by links into the work folder, beside lists of the names of each split.
- Held out: a data set of the training views alone, at half the size, some of which are test views, in the work folder:
  for choosing settings without looking at test views.
"""

import json
import shutil
import struct
from pathlib import Path

from PIL import Image

from nrfgs_lab.bench.spec import Scene
from nrfgs_lab.lock import only_one
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole, write_whole

TEST_EVERY = 8
QUALITY = 92
"""Quality of the JPEGs of held-out data sets."""
MODELS = ("sparse/0", "colmap/sparse/0", "sparse")
"""Places of a COLMAP reconstruction."""
ROUNDINGS = {
    "floor": lambda side, factor: side // factor,
    "round": lambda side, factor: int(side / factor + 0.5),
    "ceil": lambda side, factor: -(-side // factor),
}
"""nerfstudio's option -> side of a downscaled image."""


def parser_options(root: Path, scene: Scene, mirrors: Path) -> list[str]:
    """Name and options of the data parser, the last words of ns-train's command line.

    Mirrored and held-out data sets are written below `mirrors`. InputError if the folder has neither layout, or the
    downscaled images are missing or of an unknown size.
    """
    folder, mirror = root / scene.path, mirrors / scene.name
    if scene.held_out is not None:
        with only_one(mirror.with_name(f"{mirror.name}.lock"), f"Another process makes {mirror}; waiting for it."):
            if not (mirror / "transforms.json").exists():
                make_held_out(folder, mirror, scene.held_out, scene.views)
        return ["nrfgs-data", "--data", str(mirror), *scene.options]
    if (folder / "transforms.json").is_file():
        scale = [] if scene.downscale is None else ["--downscale-factor", str(scene.downscale)]
        split = [] if names_its_split(folder / "transforms.json") else ["--eval-mode", "interval"]
        return ["nrfgs-data", "--data", str(folder), *split, *scale, *scene.options]
    model = colmap_model(folder)
    if model is None:
        raise InputError(
            f"{folder} has neither transforms.json nor a COLMAP reconstruction ({', '.join(MODELS)} with cameras.bin "
            "or cameras.txt). Give a folder in one of these layouts (--scenes ROOT, and scenes: in the file)."
        )
    factor = scene.downscale or 1
    mirror_with_split(folder, model, mirror)
    return [
        *("colmap", "--data", str(mirror), "--colmap-path", model),
        *("--downscale-factor", str(factor)),
        *(["--downscale-rounding-mode", rounding(folder, factor, model)] if factor > 1 else []),
        *scene.options,
    ]


def held_out_views(names: list[str], first: int) -> list[str]:
    """Views to hold out: every 8th; every 6th of fewer than 30 views if every 8th gives fewer than three."""
    chosen = names[first::TEST_EVERY]
    return names[first::6] if len(names) < 30 and len(chosen) < 3 else chosen


def make_held_out(folder: Path, out: Path, first: int, views: int | None = None) -> None:
    """Write a data set of a capture's training views at half the size into `out`.

    `first` is the first held-out view by name; `views` of the others stay, evenly spaced. InputError if the capture
    names no training views.
    """
    file = folder / "transforms.json"
    meta = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if not meta.get("train_filenames"):
        raise InputError(f"{file} names no train_filenames. Give a capture that names its split (nrfgs prepare does).")
    training = set(meta["train_filenames"])
    frames = sorted((one for one in meta["frames"] if one["file_path"] in training), key=lambda one: one["file_path"])
    size = meta["w"] // 2, meta["h"] // 2
    for frame in frames:
        for key in {"file_path", "mask_path"} & frame.keys():
            target = out / frame[key]
            target.parent.mkdir(parents=True, exist_ok=True)
            with Image.open(folder / frame[key]) as picture:
                small = picture.convert("RGB" if key == "file_path" else "L").resize(size, Image.Resampling.BOX)
                small.save(target, quality=QUALITY)
    names = [frame["file_path"] for frame in frames]
    test = held_out_views(names, first)
    others = [name for name in names if name not in test]
    for keys, factor in ((("fl_x", "cx"), size[0] / meta["w"]), (("fl_y", "cy"), size[1] / meta["h"])):
        meta |= {key: meta[key] * factor for key in keys}
    meta |= {"w": size[0], "h": size[1], "frames": frames, "test_filenames": test, "val_filenames": test}
    meta["train_filenames"] = [others[i] for i in evenly_spaced(len(others), views or len(others))]
    if "ply_file_path" in meta:
        shutil.copy(folder / meta["ply_file_path"], out / meta["ply_file_path"])
    write_whole(out / "transforms.json", json.dumps(meta, indent=1))


def names_its_split(transforms: Path) -> bool:
    """Whether a data set names its split. The data parser refuses files that cannot be read."""
    try:
        return any(f"{split}_filenames" in json.loads(transforms.read_bytes()) for split in ("train", "val", "test"))
    except (OSError, ValueError, TypeError):
        return False


def colmap_model(folder: Path) -> str | None:
    """Path of the reconstruction in a folder, or None."""
    for model in MODELS:
        if any((folder / model / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return model
    return None


def image_names(model: Path) -> list[str]:
    """Sorted names of a reconstruction's images, from text if there is text (as nerfstudio); InputError if torn."""
    from nerfstudio.data.utils.colmap_parsing_utils import read_images_binary, read_images_text

    text = (model / "cameras.txt").is_file()
    file = model / ("images.txt" if text else "images.bin")
    try:
        images = read_images_text(file) if text else read_images_binary(file)
    except (OSError, ValueError, IndexError, struct.error) as error:
        raise InputError(
            f"{file} cannot be read as COLMAP's ({error}). Restore it, or export the model anew."
        ) from error
    return sorted(image.name for image in images.values())


def mirror_with_split(folder: Path, model: str, mirror: Path) -> None:
    """Link the content of `folder` into `mirror`, beside lists of training and test images; replace links elsewhere."""
    names = image_names(folder / model)
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


def rounding(folder: Path, factor: int, model: str) -> str:
    """Rounding of the sides of images_FACTOR, from the first image of the reconstruction."""
    originals, smaller = folder / "images", folder / f"images_{factor}"
    if not smaller.is_dir():
        raise InputError(
            f"{smaller} is missing. Downscale the images into it, or choose a factor that is there (scenes: downscale)."
        )
    name = image_names(folder / model)[0]
    original, same = originals / name, smaller / name
    for file in (original, same):
        if not file.is_file():
            raise InputError(f"{smaller} and {originals} must hold images of the same names; {file} is missing.")
    with Image.open(original) as large, Image.open(same) as small:
        sizes = large.size, small.size
    for mode, rounded in ROUNDINGS.items():
        if tuple(rounded(side, factor) for side in sizes[0]) == sizes[1]:
            return mode
    raise InputError(
        f"{same} is {sizes[1][0]} x {sizes[1][1]}, which is not {sizes[0][0]} x {sizes[0][1]} / {factor} however "
        "rounded. Downscale the images again."
    )
