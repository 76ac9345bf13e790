# SPDX-License-Identifier: Apache-2.0
"""`nrfgs-data`: nerfstudio's own data sets, checked up front, every 8th image for testing, points read by plyfile; and
what reads COLMAP's models in its place.

Both layouts become one dictionary, that of transforms.json, so that there is one way from it to cameras, and the same
checks on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import MAX_AUTO_RESOLUTION, NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.data.utils.dataparsers_utils import (
    get_train_eval_split_all,
    get_train_eval_split_filename,
    get_train_eval_split_fraction,
    get_train_eval_split_interval,
)
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from nrfgs_ns.data.checks import (
    SMALLEST,
    check_exist,
    check_frames,
    check_headers,
    check_intrinsics,
    check_options,
    check_poses,
    check_unique,
    could_exist,
    exists,
    number,
    read_transforms,
    shown,
    some,
    warn,
)
from nrfgs_ns.data.colmap import read_model
from nrfgs_ns.data.lenses import cameras_of, size_of
from nrfgs_ns.data.pictures import read_header, smaller_copies, stored_exif
from nrfgs_ns.data.points import read_colmap, read_ply
from nrfgs_ns.data.sight import check_sight, in_reach
from nrfgs_ns.data.views import interior_test_images
from nrfgs_ns.data.world import PlacedOutputs, after, place
from nrfgs_ns.errors import InputError
from nrfgs_ns.start import with_data_parsers

with_data_parsers()

SPLITS = ("train", "val", "test")
"""nerfstudio's names of the parts of a data set."""
STAND_INS = {"val": ("val", "test", "train"), "test": ("test", "val", "train")}
"""Which part is evaluated: the first of these that has images."""
MASK_MODES = ("1", "L", "I", "I;16")
"""PIL modes with one value per pixel that means something by itself (a palette index does not)."""
MIN_POINTS = 4
"""Fewer points cannot start a training: a splat's first size is its distance to its three nearest neighbours."""
ORIENTATIONS = ("pca", "up", "vertical", "none")
FOLDERS = {"file_path": "images", "mask_path": "masks", "depth_file_path": "depths"}
"""Where smaller copies of a frame's files are, followed by _ and the factor."""
COLMAP_TO_FRAMES = torch.tensor([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""The applied_transform of data sets from before nerfstudio wrote it down."""
COLMAP_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""nerfstudio's turn of COLMAP's world, whose y points downwards, to one whose z points upwards."""


@dataclass
class NrfgsDataParserConfig(NerfstudioDataParserConfig):
    """nerfstudio's transforms.json, with the defaults of comparisons in the literature."""

    _target: type = field(default_factory=lambda: NrfgsDataParser)
    """target class to instantiate"""
    eval_mode: Literal["interior", "interval", "fraction", "filename", "all"] = "interior"
    """test images where the data set names none. interior: every eval_interval-th by name, from the middle of the first
    interval on. interval: from the first on. fraction: all but train_split_fraction. filename: by train or eval in the
    name. all: every image is both"""
    load_3D_points: bool = True
    """start from the points of the data set (ply_file_path, otherwise colmap/sparse/0)"""


class Scene(NamedTuple):
    """A whole data set, before it is split."""

    meta: dict[str, Any]
    """what transforms.json says, or would say"""
    source: Path
    """the file that messages name"""
    splits: dict[str, np.ndarray]
    """rows of each split"""
    factor: int
    """by which images are smaller than the intrinsics say"""
    cameras: Cameras
    """all of them, placed and of the size of the images"""
    transform: torch.Tensor
    """[3, 4], from the frames' world to the cameras', before `scale`"""
    to_frames: torch.Tensor | None
    """[3, 4], from the original world to the frames'"""
    scale: float


class NrfgsDataParser(DataParser):
    """nerfstudio's parser, with these differences.

    - The data set is checked before it is parsed (see `checks`); what cannot be used raises InputError.
    - If val or test has no images, the other stands in; if both have none, the training images are evaluated, with a
      warning.
    - A data set of one image loads. It keeps its own scale, having no extent to normalise by.
    - Points are read by plyfile instead of open3d, or straight from colmap/sparse/0, where nerfstudio asks a question
      at the terminal and then writes into the data set.
    - Cameras far from the origin are moved there in float64 (see `world`).
    - With a downscale_factor of which there is no folder, images are resized into a cache.
    - To render from a checkpoint, nerfstudio announces that it needs no images (it presets `downscale_factor`). Then
      neither images nor points need be there.
    """

    config: NerfstudioDataParserConfig
    downscale_factor: int | None = None
    """set by nerfstudio, before the parsing, if no image is needed"""

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        """Parses one split; the first call checks the whole data set."""
        scene = self._scene
        chosen = next((name for name in STAND_INS.get(split, ()) if len(scene.splits[name])), split)
        if chosen == "train" != split:
            warn(f"{scene.source}: no image is kept for {split}. The training images are evaluated instead.")
        rows = scene.splits[chosen]
        frames = [scene.meta["frames"][row] for row in rows]
        files = {key: self._files(frames, key, scene.factor) for key in FOLDERS}
        cameras = scene.cameras[torch.from_numpy(rows)]
        if self._images_needed:
            sizes = list(zip(cameras.width.flatten().tolist(), cameras.height.flatten().tolist(), strict=True))
            files = self._checked_files(scene, frames, files, sizes)
        box = self.config.scene_scale * torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        outputs = PlacedOutputs(
            image_filenames=files["file_path"],
            cameras=cameras,
            scene_box=SceneBox(aabb=box),
            mask_filenames=files["mask_path"] or None,
            dataparser_scale=scene.scale * number(scene.meta.get("applied_scale", 1.0)),
            dataparser_transform=after(scene.transform, scene.to_frames),
            metadata={
                "depth_filenames": files["depth_file_path"] or None,
                "exif": [stored_exif(frame, scene.source) for frame in frames],
                "depth_unit_scale_factor": self.config.depth_unit_scale_factor,
                "mask_color": getattr(self.config, "mask_color", None),
            },
        )
        if self.config.load_3D_points and self._images_needed:  # rendering from a checkpoint needs no points
            outputs.metadata |= self._placed_points
        return outputs

    @cached_property
    def _images_needed(self) -> bool:
        """Whether nerfstudio asks for images."""
        return self.downscale_factor is None

    # From files to a scene.

    @cached_property
    def _scene(self) -> Scene:
        """The whole data set, checked as far as can be done without opening all images."""
        check_options(self.config)
        meta, source = self._read()
        frames, config = meta["frames"], self.config
        check_intrinsics(meta, source)
        check_poses(frames, source, need_spread=config.auto_scale_poses and len(frames) > 1)
        if getattr(config, "mask_color", None) is not None and "mask_path" not in frames[0]:
            raise InputError(
                f"{source}: --mask-color is set, but no frame has a mask_path. Add masks or drop the option."
            )
        if self._images_needed:
            if config.downscale_factor is None:  # the first image in its full size decides
                check_exist([self._file(frame["file_path"]) for frame in frames], source, "images")
            factor = self._factor(frames)
            for key in FOLDERS:
                what = "images" if key == "file_path" else f"files of {key}"
                check_exist(self._files(frames, key, factor), source, what)
        else:
            factor = self.downscale_factor
        frames = meta["frames"] = self._order(frames)
        paths = [self._file(frame["file_path"]) for frame in frames]
        check_unique(paths, f"{source}: frames")
        splits = self._splits(meta, source, paths)
        if not len(splits["train"]):
            raise InputError(
                f"{source}: no image is left for training. Correct train_filenames if it is there, else --eval-mode, "
                "--eval-interval or --train-split-fraction."
            )
        orientation = meta.get("orientation_override", config.orientation_method)
        if orientation not in ORIENTATIONS:
            raise InputError(
                f"{source}: orientation_override is {shown(repr(orientation))}. Use one of {', '.join(ORIENTATIONS)}, "
                "or remove it."
            )
        single = len(frames) == 1
        poses, transform, scale = place(
            np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64),
            "up" if single and orientation == "vertical" else orientation,  # which needs two cameras
            config.center_method,
            config.auto_scale_poses and not single,
            config.scale_factor,
        )
        if not torch.isfinite(poses).all():
            raise InputError(
                f"{source}: the poses cannot be oriented (their up directions cancel). "
                "Set --orientation-method none, or recompute the poses."
            )
        cameras = cameras_of(meta, poses, source)
        rounding = getattr(config, "downscale_rounding_mode", "floor")
        cameras.rescale_output_resolution(scaling_factor=1.0 / factor, scale_rounding_mode=rounding)
        if min(cameras.width.min(), cameras.height.min()) < SMALLEST:
            raise InputError(
                f"{source}: --downscale-factor {factor} leaves images of {cameras.width.min()} x "
                f"{cameras.height.min()} pixels. Give a smaller one."
            )
        return Scene(meta, source, splits, factor, cameras, transform, self._to_frames(meta), scale)

    def _read(self) -> tuple[dict[str, Any], Path]:
        """What the data set says, and the file that it says so in."""
        meta, source = read_transforms(self.config.data)
        self._folder = source.parent
        check_frames(meta["frames"], source)
        return meta, source

    def _order(self, frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """The frames in the order that they are split in: by name, as in nerfstudio."""
        return sorted(frames, key=lambda frame: self._file(frame["file_path"]))

    def _to_frames(self, meta: dict[str, Any]) -> torch.Tensor | None:
        """The transform [3, 4] that has already been applied to the frames' poses, if one has."""
        if "applied_transform" in meta:
            return torch.tensor(np.array(meta["applied_transform"], dtype=np.float64))
        return COLMAP_TO_FRAMES if self._colmap.exists() else None

    @property
    def _colmap(self) -> Path:
        return self._folder / "colmap" / "sparse" / "0"

    def _file(self, name: str, key: str = "file_path") -> Path:
        """A file that a frame names, in full size."""
        return self._folder / name

    def _root(self, key: str) -> Path:
        """The folder of a frame's files of one kind, in full size."""
        return self._folder / FOLDERS[key]

    def _smaller(self, key: str, factor: int) -> Path:
        """The folder where the data set keeps its own copies at 1 / factor of the size, if it does."""
        root = self._root(key)
        return root.with_name(f"{root.name}_{factor}")

    def _copy(self, name: str, key: str, factor: int) -> Path:
        return self._smaller(key, factor) / Path(name).name

    def _may_halve(self, name: str, factor: int) -> bool:
        """Whether images may be taken at 1 / factor of their size without having been asked for."""
        return self._copy(name, "file_path", factor).exists()

    def _factor(self, frames: list[dict[str, Any]]) -> int:
        """The factor that was asked for, or the smallest power of two that makes the first image no larger than 1600
        pixels and that `_may_halve` admits."""
        if self.config.downscale_factor is not None:
            return self.config.downscale_factor
        name = frames[0]["file_path"]
        size, factor = max(read_header(self._file(name))[0]), 1
        while size / factor > MAX_AUTO_RESOLUTION and self._may_halve(name, 2 * factor):
            factor *= 2
        return factor

    def _files(self, frames: list[dict[str, Any]], key: str, factor: int) -> list[Path]:
        """The files of some frames, in full size or, where the data set has copies of the size wanted, those."""
        names = [frame[key] for frame in frames if key in frame]
        copies = names and self._has_copies(key, factor)
        return [self._copy(name, key, factor) if copies else self._file(name, key) for name in names]

    def _has_copies(self, key: str, factor: int) -> bool:
        return factor > 1 and self._smaller(key, factor).is_dir()

    def _checked_files(
        self,
        scene: Scene,
        frames: list[dict[str, Any]],
        files: dict[str, list[Path]],
        sizes: Sequence[tuple[int, int]],
    ) -> dict[str, list[Path]]:
        """The same files, found to have the sizes that their cameras have; those that are larger, resized."""
        scale_all = "Use the images that the poses were computed from, or scale w, h, fl_x, fl_y, cx and cy alike."
        for key, what, fix in (
            ("file_path", "images", scale_all),
            ("mask_path", "masks", "Make them as large as the images."),
        ):
            if not files[key]:
                continue
            shrink = scene.factor > 1 and not self._has_copies(key, scene.factor)
            if not shrink:
                check_unique(files[key], f"{scene.source}: frames")
            expected = [size_of(scene.meta, frame) for frame in frames] if shrink else sizes
            modes = check_headers(files[key], expected, what, fix)
            if key == "mask_path":
                bad = [path for path, mode in zip(files[key], modes, strict=True) if mode not in MASK_MODES]
                if bad:
                    raise InputError(
                        f"{some(bad)}: a mask must have one grey channel (0 outside, anything else inside), not "
                        "colours or a palette. Save it as 8-bit grey."
                    )
            if shrink:
                files = {**files, key: smaller_copies(files[key], sizes, what)}
        return files

    # Splits.

    def _splits(self, meta: dict[str, Any], source: Path, images: list[Path]) -> dict[str, np.ndarray]:
        """The rows of each split, int64."""
        named = self._named_splits(meta, source)
        if named is not None:
            return self._rows_of(named, source, images)
        if len(images) == 1:
            return {"train": np.array([0]), "val": np.empty(0, int), "test": np.empty(0, int)}
        config = self.config
        if config.eval_mode == "interior":
            if config.eval_interval < 2:
                raise InputError(
                    f"--eval-interval is {config.eval_interval}. Give 2 or more, or choose another --eval-mode."
                )
            evaluated = np.array(interior_test_images(len(images), config.eval_interval))
            return {"train": np.setdiff1d(np.arange(len(images)), evaluated), "val": evaluated, "test": evaluated}
        try:
            train, evaluated = {
                "fraction": lambda: get_train_eval_split_fraction(images, config.train_split_fraction),
                "filename": lambda: get_train_eval_split_filename(images),
                "interval": lambda: get_train_eval_split_interval(images, config.eval_interval),
                "all": lambda: get_train_eval_split_all(images),
            }[config.eval_mode]()
        except (AssertionError, ValueError, KeyError) as error:
            raise InputError(
                f"{source}: --eval-mode {config.eval_mode} cannot split these images ({error}). Choose another."
            ) from error
        train, evaluated = (np.asarray(rows, dtype=np.int64) for rows in (train, evaluated))
        return {"train": train, "val": evaluated, "test": evaluated}

    def _named_splits(self, meta: dict[str, Any], source: Path) -> dict[str, tuple[str, Any]] | None:
        """The splits that the data set names itself, if it does: what names it, and the names."""
        named = {split: (f"{split}_filenames", meta.get(f"{split}_filenames")) for split in SPLITS}
        return {k: v for k, v in named.items() if v[0] in meta} or None

    def _rows_of(self, named: dict[str, tuple[str, Any]], source: Path, images: list[Path]) -> dict[str, np.ndarray]:
        """The rows of splits that are named, which must name images that there are."""
        members = dict.fromkeys(SPLITS, frozenset())
        for split, (field_name, names) in named.items():
            where = f"{source}: {field_name}"
            if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
                raise InputError(f"{where} is not a list of file paths. Correct or remove it.")
            paths = [self._file(name) for name in names]
            check_unique(paths, where)
            members[split] = frozenset(paths)
            unknown = sorted(members[split].difference(images))
            if unknown:
                raise InputError(
                    f"{where} names {some(unknown)}, of which there is no frame. Use each frame's file_path."
                )
        shared = sorted(members["train"] & (members["val"] | members["test"]))
        if shared:
            warn(f"{source}: {some(shared)} are for training and for evaluation, whose results this flatters.")
        return {
            split: np.array([row for row, path in enumerate(images) if path in paths], dtype=np.int64)
            for split, paths in members.items()
        }

    # Points.

    def _points(self, scene: Scene) -> tuple[np.ndarray, np.ndarray, torch.Tensor] | None:
        """Positions [N, 3] and colours [N, 3] as stored, and the transform [3, 4] from their world to the cameras'
        before scaling; None without."""
        if "ply_file_path" in scene.meta:
            name = scene.meta["ply_file_path"]
            if not (isinstance(name, str) and could_exist(name)):
                raise InputError(f"{scene.source}: ply_file_path is {shown(repr(name))}. Name a file, or remove it.")
            return *read_ply(self._file(name)), scene.transform
        if self._colmap.is_dir():
            return *read_colmap(self._colmap), after(scene.transform, scene.to_frames)
        return None

    @cached_property
    def _placed_points(self) -> dict[str, torch.Tensor]:
        """points3D_xyz float32 [N, 3] and points3D_rgb uint8 [N, 3] in the world of the cameras, which see enough of
        them; nothing (and a warning) without."""
        scene = self._scene
        points = self._points(scene)
        count = 0 if points is None else len(points[0])
        if count < MIN_POINTS:
            found = "the data set has no point cloud (no ply_file_path, no colmap/sparse/0)"
            if points is not None:
                found = f"the point cloud holds {count} usable points, fewer than {MIN_POINTS}"
            warn(f"{scene.source}: {found}. Training starts from random points, which costs quality.")
            return {}
        xyz, rgb, transform = (torch.as_tensor(table) for table in points)
        transform = transform.double()
        scale = scene.scale * number(scene.meta.get("applied_scale", 1.0))
        xyz = scale * (xyz @ transform[:, :3].T + transform[:, 3])
        near = torch.from_numpy(in_reach(xyz.numpy(), scene.cameras, scene.source))
        xyz, rgb = xyz[near].float(), rgb[near]
        rows = scene.splits["train"]
        names = [scene.meta["frames"][row]["file_path"] for row in rows]
        check_sight(xyz, scene.cameras[torch.from_numpy(rows)], names, scene.source)
        return {"points3D_xyz": xyz, "points3D_rgb": rgb}


class NrfgsColmapDataParser(NrfgsDataParser):
    """nerfstudio's `colmap` parser, with the checks of `NrfgsDataParser` and without questions at the terminal.

    Images that are larger than 1600 pixels are resized by a power of two, as nerfstudio proposes. Multiple cameras may
    be of several models if all are pinholes or all are fisheyes.
    """

    config: ColmapDataParserConfig

    def _read(self) -> tuple[dict[str, Any], Path]:
        self._folder = self.config.data
        if not exists(self._folder):
            raise InputError(f"{shown(str(self._folder))}: no such folder. Check the path that --data names.")
        cameras, views, source = read_model(self._colmap)
        kinds = {cameras[view.camera]["camera_model"] for view in views}
        if len(kinds) > 1:
            raise InputError(f"{source}: some cameras are fisheyes and some are not. Undistort the photographs.")
        upright = COLMAP_UPRIGHT if self.config.assume_colmap_world_coordinate_convention else np.eye(4)
        frames = []
        for view in views:
            frame = {"file_path": view.name, **cameras[view.camera]}
            pose = upright @ np.linalg.inv(view.world_to_camera)
            frame["transform_matrix"] = pose * np.array([1.0, -1.0, -1.0, 1.0])  # y up, z backwards
            if self.config.masks_path is not None:
                frame["mask_path"] = view.name
            if self.config.depths_path is not None:
                frame["depth_file_path"] = view.name
            frames.append(frame)
        meta = {"frames": frames, "camera_model": kinds.pop()}
        if self.config.assume_colmap_world_coordinate_convention:
            meta["applied_transform"] = COLMAP_UPRIGHT[:3].tolist()
        check_frames(frames, source)
        return meta, source

    def _order(self, frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return frames  # by COLMAP's numbers

    def _to_frames(self, meta: dict[str, Any]) -> torch.Tensor | None:
        return torch.tensor(meta["applied_transform"]) if "applied_transform" in meta else None

    @property
    def _colmap(self) -> Path:
        return self._folder / self.config.colmap_path

    def _root(self, key: str) -> Path:
        config = self.config
        folders = {
            "file_path": config.images_path,
            "mask_path": config.masks_path,
            "depth_file_path": config.depths_path,
        }
        return self._folder / folders[key]

    def _file(self, name: str, key: str = "file_path") -> Path:
        path = self._root(key) / name
        return path if key == "file_path" else path.with_suffix(".png")

    def _copy(self, name: str, key: str, factor: int) -> Path:
        return self._smaller(key, factor) / self._file(name, key).relative_to(self._root(key))

    def _may_halve(self, name: str, factor: int) -> bool:
        return True

    def _named_splits(self, meta: dict[str, Any], source: Path) -> dict[str, tuple[str, Any]] | None:
        named = {}
        for split, file in (("train", "train"), ("val", "val"), ("val", "validation"), ("test", "test")):
            path = self._folder / f"{file}_list.txt"
            if path.is_file():
                try:
                    lines = path.read_text(encoding="utf-8").splitlines()
                except (OSError, ValueError) as error:
                    raise InputError(f"{path} cannot be read ({error}). Write one image name on each line.") from error
                named[split] = path.name, [line.strip() for line in lines if line.strip()]
        return named or None

    def _points(self, scene: Scene) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
        return *read_colmap(self._colmap), after(scene.transform, scene.to_frames)


def checked(config: DataParserConfig) -> DataParserConfig:
    """The configuration of a parser that checks what it reads, for nerfstudio's own two, and any other as it is."""
    parsers = {NerfstudioDataParserConfig: NrfgsDataParser, ColmapDataParserConfig: NrfgsColmapDataParser}
    return replace(config, _target=parsers[type(config)]) if type(config) in parsers else config


nrfgs_dataparser = DataParserSpecification(
    config=NrfgsDataParserConfig(),
    description="nerfstudio data, checked up front; every 8th image is for test; points without open3d.",
)
