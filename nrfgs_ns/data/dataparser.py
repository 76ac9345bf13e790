# SPDX-License-Identifier: Apache-2.0
"""`nrfgs-data`: nerfstudio's own data sets, checked up front, every 8th image for testing, points read by plyfile."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.utils.dataparsers_utils import (
    get_train_eval_split_all,
    get_train_eval_split_filename,
    get_train_eval_split_fraction,
    get_train_eval_split_interval,
)
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from nrfgs_ns.data.checks import (
    check_exist,
    check_frames,
    check_headers,
    check_intrinsics,
    check_poses,
    check_unique,
    read_header,
    read_transforms,
    some,
    warn,
)
from nrfgs_ns.data.points import read_colmap, read_ply
from nrfgs_ns.data.split import interior_test_images
from nrfgs_ns.errors import InputError

SPLITS = ("train", "val", "test")
"""nerfstudio's names of the parts of a data set."""
STAND_INS = {"val": ("val", "test", "train"), "test": ("test", "val", "train")}
"""Which part is evaluated: the first of these that has images."""
MASK_MODES = ("1", "L", "I", "I;16")
"""PIL modes with one value per pixel that means something by itself (a palette index does not)."""
MIN_POINTS = 4
"""Fewer points cannot start a training: a splat's first size is its distance to its three nearest neighbours."""


@dataclass
class NrfgsDataParserConfig(NerfstudioDataParserConfig):
    """nerfstudio's transforms.json, with the defaults of comparisons in the literature."""

    _target: type = field(default_factory=lambda: NrfgsDataParser)
    """target class to instantiate"""
    eval_mode: Literal["interior", "interval", "fraction", "filename", "all"] = "interior"
    """How to split into train and eval if the data set does not name its own split: interior (every eval_interval-th by
    sorted name is eval, beginning in the middle of the first eval_interval images), interval (beginning with the first,
    as in the literature), fraction (train_split_fraction of them train), filename (train or eval in the name), all
    (every image is both)."""
    load_3D_points: bool = True
    """Whether to start from the points of the data set (ply_file_path, or else colmap/sparse/0)."""


class NrfgsDataParser(Nerfstudio):
    """nerfstudio's parser, with these differences.

    - The data set is checked before it is parsed (see `checks`); what cannot be used raises InputError.
    - If val or test has no images, the other stands in; if both have none, the training images are evaluated, with a
      warning.
    - A data set of one image loads. It keeps its own scale, having no extent to normalise by.
    - Points are read by plyfile instead of open3d, or straight from colmap/sparse/0, where nerfstudio asks a question
      at the terminal and then writes into the data set.
    - To render from a checkpoint, nerfstudio announces that it needs no images (it presets `downscale_factor`). Then
      neither images nor points need be there.
    """

    config: NrfgsDataParserConfig

    def __init__(self, config: NrfgsDataParserConfig):
        super().__init__(config)
        self._meta: dict[str, Any] | None = None  # until the checks have passed

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        """Parses one split; the first call checks the whole data set."""
        if self._meta is None:
            meta, self._source = read_transforms(self.config.data)
            self._check(meta)
            self._meta = meta
        own_config = self.config
        interior = self._splits_interior(self._meta)
        self.config = self._host_config()
        try:
            part = self._host_split(split)
            outputs = super()._generate_dataparser_outputs("train" if interior else part)
        finally:
            self.config = own_config
        if interior:
            test = interior_test_images(len(outputs.image_filenames), self.config.eval_interval)
            train = [index for index in range(len(outputs.image_filenames)) if index not in test]
            outputs = _select(outputs, train if part == "train" else list(test))
        self._check_outputs(outputs)
        if self._points_wanted and "ply_file_path" not in self._meta:
            # nerfstudio has loaded none. COLMAP's world is the "original" one that dataparser_transform starts from.
            outputs.metadata.update(self._placed(outputs.dataparser_transform, outputs.dataparser_scale) or {})
        return outputs

    def _host_config(self) -> NrfgsDataParserConfig:
        """The configuration for which nerfstudio's parser does what this one promises."""
        config = replace(
            self.config,
            # nerfstudio looks for colmap/sparse/0 and its axes only beside a folder, not beside a file in it.
            data=self._source.parent if self._source.name == "transforms.json" else self._source,
            # Without a .ply it would turn to the terminal.
            load_3D_points=self._points_wanted and "ply_file_path" in self._meta,
        )
        if self._splits_interior(self._meta):
            return replace(config, eval_mode="fraction", train_split_fraction=1.0)  # everything, for us to choose from
        if len(self._meta["frames"]) > 1:
            return config
        vertical = config.orientation_method == "vertical"  # needs two cameras
        return replace(
            config,
            auto_scale_poses=False,
            orientation_method="up" if vertical else config.orientation_method,
            eval_mode="fraction",
            train_split_fraction=1.0,
        )

    def _splits_interior(self, meta: dict[str, Any]) -> bool:
        """Whether the split is ours, which nerfstudio does not have."""
        named = any(f"{split}_filenames" in meta for split in SPLITS)
        return self.config.eval_mode == "interior" and not named and len(meta["frames"]) > 1

    def _host_split(self, split: str) -> str:
        """The split that nerfstudio is asked for: itself, or the stand-in for one without images."""
        chosen = next((name for name in STAND_INS.get(split, ()) if self._counts[name]), split)
        if chosen == "train" != split:
            warn(f"{self._source}: no image is kept for {split}. The training images are evaluated instead.")
        return chosen

    # Checks.

    def _check(self, meta: dict[str, Any]) -> None:
        """Everything that can be checked before parsing."""
        frames, source, config = meta["frames"], self._source, self.config
        check_frames(frames, source)
        check_intrinsics(meta, source)
        check_poses(frames, source, need_spread=config.auto_scale_poses and len(frames) > 1)
        if config.mask_color is not None and "mask_path" not in frames[0]:
            raise InputError(
                f"{source}: --mask-color is set, but no frame has a mask_path. Add masks or drop the option."
            )
        if config.downscale_factor is not None and config.downscale_factor < 1:
            raise InputError(f"--downscale-factor is {config.downscale_factor}. Give 1 or more, or leave it out.")
        if config.eval_mode == "interior" and config.eval_interval < 2:
            raise InputError(
                f"--eval-interval is {config.eval_interval}. Give 2 or more, or choose another --eval-mode."
            )
        if self._images_needed and config.downscale_factor is None:
            # nerfstudio chooses the factor by the first image in its full size.
            originals = [source.parent / frame["file_path"] for frame in frames]
            if not originals[0].is_file():
                check_exist(originals, source, "images")
            read_header(originals[0])
        images = [self._get_fname(Path(frame["file_path"]), source.parent) for frame in frames]
        check_unique(images, f"{source}: frames")
        if self._images_needed:
            check_exist(images, source, "images")
            for key, prefix in (("mask_path", "masks_"), ("depth_file_path", "depths_")):
                names = [Path(frame[key]) for frame in frames if key in frame]
                paths = [self._get_fname(name, source.parent, downsample_folder_prefix=prefix) for name in names]
                check_exist(paths, source, f"files of {key}")
        self._counts = self._count_splits(meta, images)
        if not self._counts["train"]:
            raise InputError(
                f"{source}: no image is left for training. Correct train_filenames if it is there, else --eval-mode, "
                "--eval-interval or --train-split-fraction."
            )

    def _count_splits(self, meta: dict[str, Any], images: list[Path]) -> dict[str, int]:
        """How many images each split has."""
        named = {split: meta[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in meta}
        if named:
            return self._count_named(named, images)
        config = self.config
        if self._splits_interior(meta):
            evaluated = len(interior_test_images(len(images), config.eval_interval))
            return {"train": len(images) - evaluated, "val": evaluated, "test": evaluated}
        try:
            train, evaluated = {
                "interior": lambda: (images, []),  # one image, which is nerfstudio's to treat: see _host_config
                "fraction": lambda: get_train_eval_split_fraction(images, config.train_split_fraction),
                "filename": lambda: get_train_eval_split_filename(images),
                "interval": lambda: get_train_eval_split_interval(images, config.eval_interval),
                "all": lambda: get_train_eval_split_all(images),
            }[config.eval_mode]()
        except (AssertionError, ValueError) as error:
            raise InputError(
                f"{self._source}: --eval-mode {config.eval_mode} cannot split these images ({error}). Choose another."
            ) from error
        if len(images) == 1:  # see _host_config
            return {"train": 1, "val": 0, "test": 0}
        return {"train": len(train), "val": len(evaluated), "test": len(evaluated)}

    def _count_named(self, named: dict[str, list[str]], images: list[Path]) -> dict[str, int]:
        """The same if the data set names its own splits, which must name images that it has."""
        members = dict.fromkeys(SPLITS, frozenset())
        for split, names in named.items():
            where = f"{self._source}: {split}_filenames"
            if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
                raise InputError(f"{where} is not a list of file paths. Correct or remove it.")
            paths = [self._get_fname(Path(name), self._source.parent) for name in names]
            check_unique(paths, where)
            members[split] = frozenset(paths)
            unknown = sorted(members[split].difference(images))
            if unknown:
                raise InputError(
                    f"{where} names {some(unknown)}, of which there is no frame. Use each frame's file_path."
                )
        shared = sorted(members["train"] & (members["val"] | members["test"]))
        if shared:
            warn(f"{self._source}: {some(shared)} are for training and for evaluation, whose results this flatters.")
        return {split: len(paths) for split, paths in members.items()}

    def _check_outputs(self, outputs: DataparserOutputs) -> None:
        """What is known only after parsing: finite poses, and files of the size that the scaled cameras have."""
        cameras = outputs.cameras
        if not torch.isfinite(cameras.camera_to_worlds).all():
            raise InputError(
                f"{self._source}: the poses cannot be oriented (their up directions cancel). "
                "Set --orientation-method none, or recompute the poses."
            )
        if not self._images_needed:
            return
        sizes = list(zip(cameras.width.flatten().tolist(), cameras.height.flatten().tolist(), strict=True))
        mend = "Use the images that the poses were computed from, or scale w, h, fl_x, fl_y, cx and cy alike."
        check_headers(outputs.image_filenames, sizes, "images", mend)
        if outputs.mask_filenames is not None:
            modes = check_headers(outputs.mask_filenames, sizes, "masks", "Make them as large as the images.")
            bad = [path for path, mode in zip(outputs.mask_filenames, modes, strict=True) if mode not in MASK_MODES]
            if bad:
                raise InputError(
                    f"{some(bad)}: a mask must have one grey channel (0 outside, anything else inside), not colours "
                    "or a palette. Save it as 8-bit grey."
                )

    @cached_property
    def _images_needed(self) -> bool:
        """Whether nerfstudio asks for images. First read before the parsing, which sets the factor itself."""
        return self.downscale_factor is None

    # Points.

    @property
    def _points_wanted(self) -> bool:
        """Points begin a training; rendering from a checkpoint needs none."""
        return self.config.load_3D_points and self._images_needed

    @cached_property
    def _points(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Positions [N, 3] and colours [N, 3] as stored, read once for all splits; None (and a warning) without."""
        colmap = self._host_config().data / "colmap" / "sparse" / "0"
        if "ply_file_path" in self._meta:
            points = read_ply(self._source.parent / self._meta["ply_file_path"])
            found = f"{self._meta['ply_file_path']} holds {len(points[0])} usable points, fewer than {MIN_POINTS}"
        elif colmap.is_dir():
            points = read_colmap(colmap)
            found = f"{colmap} holds {len(points[0])} usable points, fewer than {MIN_POINTS}"
        else:
            points = np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)
            found = "the data set has no point cloud (no ply_file_path, no colmap/sparse/0)"
        if len(points[0]) >= MIN_POINTS:
            return points
        warn(f"{self._source}: {found}. Training starts from random points, which costs quality.")
        return None

    def _placed(self, transform: torch.Tensor, scale: float) -> dict[str, torch.Tensor] | None:
        """The points in the world of the parsed cameras: scale * (transform [3, 4] applied to each).

        Returns:
            points3D_xyz float32 [N, 3] and points3D_rgb uint8 [N, 3], or None without points.
        """
        if self._points is None:
            return None
        xyz, rgb = (torch.from_numpy(array) for array in self._points)
        transform = transform.double()
        xyz = scale * (xyz @ transform[:, :3].T + transform[:, 3])
        return {"points3D_xyz": xyz.float(), "points3D_rgb": rgb}

    def _load_3D_points(
        self, ply_file_path: Path, transform_matrix: torch.Tensor, scale_factor: float
    ) -> dict[str, torch.Tensor] | None:
        """nerfstudio's hook for the points of ply_file_path, [3, 4] and a factor away from the parsed world."""
        return self._placed(transform_matrix, scale_factor)


def _select(outputs: DataparserOutputs, indices: list[int]) -> DataparserOutputs:
    """The part of a data set whose images have these indices."""
    depths = outputs.metadata.get("depth_filenames")
    return replace(
        outputs,
        image_filenames=[outputs.image_filenames[i] for i in indices],
        mask_filenames=outputs.mask_filenames and [outputs.mask_filenames[i] for i in indices],
        cameras=outputs.cameras[torch.tensor(indices)],
        metadata={**outputs.metadata, "depth_filenames": depths and [depths[i] for i in indices]},
    )


nrfgs_dataparser = DataParserSpecification(
    config=NrfgsDataParserConfig(),
    description="nerfstudio data, checked up front; every 8th image is for test; points without open3d.",
)
