# SPDX-License-Identifier: Apache-2.0
"""Division of a data set's images into training and evaluation."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.utils import dataparsers_utils as nerfstudio_splits

from nrfgs_ns.data.checks import check_unique, some, warn
from nrfgs_ns.data.views import interior_test_images
from nrfgs_ns.errors import InputError, refusing, require

SPLITS = ("train", "val", "test")
"""nerfstudio's names of the parts of a data set."""
STAND_INS = {"val": ("val", "test", "train"), "test": ("test", "val", "train")}
"""Which part is evaluated: the first of these that has images."""

Named = Mapping[str, tuple[str, Any]]
"""Part -> the field or file that lists it, and the names of its images."""
Rows = dict[str, np.ndarray]
"""Part -> rows of the data set, int64."""


def split_by_names(named: Named, images: list[Path], path_of: Callable[[str], Path], source: Path) -> Rows:
    """Rows of listed parts; `path_of` leads from a listed name to one of `images`. InputError if a list does not hold
    names, repeats one, or names an image that the data set lacks."""
    members = dict.fromkeys(SPLITS, frozenset())
    for split, (where, names) in named.items():
        where = f"{source}: {where}"
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise InputError(f"{where} is not a list of file paths. Correct or remove it.")
        paths = [path_of(name) for name in names]
        check_unique(paths, where)
        members[split] = frozenset(paths)
        if unknown := sorted(members[split].difference(images)):
            raise InputError(f"{where} names {some(unknown)}, of which there is no frame. Use each frame's file_path.")
    if shared := sorted(members["train"] & (members["val"] | members["test"])):
        warn(f"{source}: {some(shared)} are for training and for evaluation, whose results this flatters.")
    return {
        split: np.array([row for row, path in enumerate(images) if path in paths], dtype=np.int64)
        for split, paths in members.items()
    }


def split_by_rule(config: Any, images: list[Path], source: Path) -> Rows:
    """Rows of the parts by the parser's `eval_mode`; InputError if it cannot split. A single image is for training."""
    count = len(images)
    mode, every = config.eval_mode, config.eval_interval
    if count == 1:
        train, evaluated = [0], []
    elif mode == "interior":
        require(every >= 2, "--eval-interval", every, "2 or more with --eval-mode interior (or choose another mode)")
        evaluated = interior_test_images(count, every)
        train = np.setdiff1d(np.arange(count), evaluated)
    else:
        option = {"fraction": [config.train_split_fraction], "interval": [every]}.get(mode, [])
        finding = f"{source}: --eval-mode {mode} cannot split the images"
        with refusing(finding, "Use another.", AssertionError, ValueError, KeyError):
            train, evaluated = getattr(nerfstudio_splits, f"get_train_eval_split_{mode}")(images, *option)
    train, evaluated = (np.asarray(rows, dtype=np.int64) for rows in (train, evaluated))
    return {"train": train, "val": evaluated, "test": evaluated}
