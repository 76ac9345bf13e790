# SPDX-License-Identifier: Apache-2.0
"""A checkpoint's data set, and the options that define its numbers. A training with another head or another origin of
the world is refused; learning rates, thresholds and steps may change.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.datasets.base_dataset import InputDataset

from nrfgs_ns.data.checks import some
from nrfgs_ns.data.lenses import LENS
from nrfgs_ns.densification import DensificationConfig
from nrfgs_ns.errors import InputError, shown

MEANING = (
    "pipeline.model.appearance.",
    "pipeline.model.camera_optimizer.mode.",
    "pipeline.model.rasterize_mode.",
    "pipeline.datamanager.dataparser.",
    "pipeline.datamanager.camera_res_scale_factor.",
)
"""Options, or groups of options, that define the numbers; each ends with a dot."""
NEUTRAL = (
    "pipeline.model.appearance.implementation.",
    "pipeline.datamanager.dataparser.data.",
    "pipeline.datamanager.dataparser.colmap_path.",
    "pipeline.datamanager.dataparser.images_path.",
    "pipeline.datamanager.dataparser.mask_color.",
)
"""Options in those groups that change no number, or whose images and poses are compared instead."""
FAR = 0.01
"""Largest distance that a camera may have moved, as a share of the cameras' extent, and largest change of a lens, as a
share of its focal lengths and of the image's size."""


def options_of(config: Any) -> dict[str, str]:
    """The options of a training that define its numbers."""
    return {
        name: value.__name__ if isinstance(value, type) else value if isinstance(value, str) else repr(value)
        for name, value in leaves({"pipeline": config.pipeline})
        if f"{name}.".startswith(MEANING) and not f"{name}.".startswith(NEUTRAL)
    }


def data_set_of(data: InputDataset) -> dict[str, Any]:
    """The names of a data set's images, and its cameras' centres, [V, 3], and `LENS`, [V, 6]."""
    centers = data.cameras.camera_to_worlds[:, :3, 3].detach().cpu().clone()
    lenses = torch.cat([getattr(data.cameras, name).double() for name in LENS], dim=-1).cpu()
    return {"images": [Path(name).name for name in data.image_filenames], "centers": centers, "lenses": lenses}


def check_data_set(written: Mapping[str, Any], here: Mapping[str, Any], data: object, to_train: bool) -> None:
    """Raise InputError where a checkpoint had other poses or, if it is `to_train`, other images or intrinsics."""
    fix = "Go on with the data set that it was trained on, or train anew."
    if to_train and written["images"] != here["images"]:
        differ = sorted(set(written["images"]) ^ set(here["images"]))
        what = some(differ) if differ else "in other numbers, or in another order"
        raise InputError(f"{data}: the checkpoint was trained on other images ({what}). {fix}")
    centers, now = (scene["centers"].double() for scene in (written, here))
    extent = float((centers.amax(0) - centers.amin(0)).max())
    if written["images"] != here["images"]:
        known = dict(zip(written["images"], centers, strict=True))
        centers = torch.stack([known.get(name, center) for name, center in zip(here["images"], now, strict=True)])
    moved = (centers - now).norm(dim=1) > FAR * max(extent, 1e-12)
    if bool(moved.any()):
        which = some([here["images"][i] for i in moved.nonzero().flatten().tolist()])
        raise InputError(f"{data}: the checkpoint was trained on other poses ({which} elsewhere). {fix}")
    if to_train and (lenses := written.get("lenses")) is not None:  # older checkpoints have none
        scales = lenses[:, [0, 1, 4, 5, 4, 5]]  # of a centre the image's size
        changed = (lenses - here["lenses"]).abs() > FAR * scales
        for row, column in changed.nonzero()[:1].tolist():
            was, now = (f"{scene['lenses'][row, column]:g}" for scene in (written, here))
            lens = f"{LENS[column]} of {shown(here['images'][row])} was {was} and is {now}"
            finding = f"the checkpoint was trained with other intrinsics or --downscale-factor ({lens})"
            raise InputError(f"{data}: {finding}. {fix}")


def check_options(written: Mapping[str, str], here: Mapping[str, str]) -> None:
    """Raise InputError where a checkpoint's options differ from this training's, among those that both have."""
    changed = [name for name in written if name in here and written[name] != here[name]]
    if changed:
        was = (f"--{name.replace('_', '-')} was {written[name]} and is {here[name]}" for name in changed[:3])
        raise InputError(f"The checkpoint had other options: {'; '.join(was)}. Give the same ones, or train anew.")


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of the options of a configuration, or of a dictionary of configurations."""
    if isinstance(value, DensificationConfig):
        value = str(value)  # as it is typed
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if field.name[0] != "_" or field.name == "_target"]
        value = {name: getattr(value, name) for name in names}
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}" if name else key)
    else:
        yield name, value
