# SPDX-License-Identifier: Apache-2.0
"""`nrfgs-data`: nerfstudio's own data sets, checked up front, every 8th image for testing, points read by plyfile.

COLMAP models (`colmap_parser.py`) become the dictionary of a transforms.json, so that checks and cameras are the same.
"""

import json
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import MAX_AUTO_RESOLUTION, NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.poses import to4x4
from torch import Tensor

from nrfgs_ns.data import checks
from nrfgs_ns.data.checks import PIXELS, SMALLEST, find_colmap, warn
from nrfgs_ns.data.colmap import read_points
from nrfgs_ns.data.lenses import check_distortions
from nrfgs_ns.data.pictures import known_exif, read_exif, read_size
from nrfgs_ns.data.points import check_sight, finite, in_reach, read_ply
from nrfgs_ns.data.splits import SPLITS, STAND_INS, Named, Rows, split_by_names, split_by_rule
from nrfgs_ns.errors import InputError, refusing, require, shown
from nrfgs_ns.start import with_data_parsers

with_data_parsers()

LONGEST_JSON = 2**26
"""Largest transforms.json, bytes: a hundred thousand frames."""
MIN_POINTS = 4
"""Fewer points cannot start a training: a splat's first size is its distance to its three nearest neighbours."""
FOLDERS = {"file_path": "images", "mask_path": "masks"}
"""A frame's files -> folder of their smaller copies, followed by _ and the factor."""
COLMAP_TO_FRAMES = torch.tensor([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""The applied_transform of data sets from before nerfstudio wrote it down."""
ORIENTATIONS = ("pca", "up", "vertical", "none")
FAR = 100.0
"""Distance of the cameras' mean from the origin, in their extents, above which they are moved in float64. Nearer ones
lose less than a hundredth of a pixel, and stay to the bit where nerfstudio puts them."""
FISHEYE_AT_LEAST = 1e-12
"""A distortion without effect, because nerfstudio undistorts only where some parameter is not 0."""


@dataclass
class NrfgsDataParserConfig(NerfstudioDataParserConfig):
    """nerfstudio's transforms.json, with the defaults of comparisons in the literature."""

    _target: type = field(default_factory=lambda: NrfgsDataParser)
    eval_mode: Literal["interior", "interval", "fraction", "filename", "all"] = "interior"
    """test images where the data set names none. interior: every eval_interval-th by name, from the middle of the first
    interval. interval: from the first. fraction: all except train_split_fraction. filename: by train or eval
    in the name. all: every image is both"""
    load_3D_points: bool = True
    """start from the points of the data set (ply_file_path, otherwise colmap/sparse/0)"""


class DataSet(NamedTuple):
    """A whole data set, before it is split."""

    meta: dict[str, Any]
    """the content of transforms.json, or its equivalent"""
    source: Path
    """the file that messages name"""
    splits: Rows
    """rows of each split"""
    factor: int
    """size by the intrinsics / size of the images"""
    cameras: Cameras
    """placed, of the size of the images"""
    from_frames: Tensor
    """[3, 4], from the frames' world to the cameras', before `scale`"""
    from_original: Tensor
    """[3, 4], the same from the original world, before an applied_transform"""
    scale: float


class PlacedOutputs(DataparserOutputs):
    """nerfstudio's outputs, whose way back may be in float64."""

    def transform_poses_to_original_space(self, poses: Tensor, camera_convention="opencv") -> Tensor:
        return super().transform_poses_to_original_space(poses.to(self.dataparser_transform.dtype), camera_convention)


class NrfgsDataParser(DataParser):
    """nerfstudio's parser, except that the data set is checked first, with InputError for what cannot be used; val and
    test stand in for each other, and the training images for both; points are read without open3d or a question at the
    terminal; and images without a folder for downscale_factor are resized when they are read."""

    config: NerfstudioDataParserConfig
    downscale_factor: int | None = None
    """set by nerfstudio, before the parsing, to render from a checkpoint: neither images nor points need exist"""
    _resizes = False
    """whether large images are resized without an option"""

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        """Parse one split; the first call checks the whole data set."""
        data_set = self._data_set
        chosen = next((name for name in STAND_INS.get(split, ()) if len(data_set.splits[name])), split)
        if chosen == "train" != split:
            warn(f"{data_set.source}: no image is kept for {split}. The training images are evaluated instead.")
        rows = data_set.splits[chosen]
        frames = [data_set.meta["frames"][row] for row in rows]
        images, masks = (self._files(frames, key, data_set.factor) for key in FOLDERS)
        cameras = data_set.cameras[torch.from_numpy(rows)]
        copies = all(self._has_copies(key, data_set.factor) for key in FOLDERS if key in frames[0])
        # Smaller copies have often lost their EXIF.
        full_size_exif = lambda frame: read_exif(self._path(frame["file_path"])) if copies else {}  # noqa: E731
        corner = torch.full((3,), self.config.scene_scale)
        outputs = PlacedOutputs(
            image_filenames=images,
            cameras=cameras,
            scene_box=SceneBox(aabb=torch.stack([-corner, corner])),
            mask_filenames=masks or None,
            dataparser_scale=data_set.scale,
            dataparser_transform=data_set.from_original,
            metadata={
                "exif": [known_exif(frame.get("exif")) or full_size_exif(frame) for frame in frames],
                "factor": data_set.factor,
                "downscale": 1 if copies else data_set.factor,
            },
        )
        if self.config.load_3D_points and self.downscale_factor is None:
            outputs.metadata |= self._placed_points
        return outputs

    @cached_property
    def _data_set(self) -> DataSet:
        """The whole data set, checked as far as can be done without decoding images."""
        config = self.config
        checks.check_options(config)
        if not os.path.exists(config.data):
            place = shown(str(config.data))
            raise InputError(f"{place}: no such file or folder. Check the path in --data or config.yml.")
        meta, source = self._read()
        cameras, transform, scale = self._placed_cameras(meta, source)
        factor = self._factor(meta["frames"], source) if self.downscale_factor is None else self.downscale_factor
        splits = self._splits(meta, source)
        full_sizes = torch.cat([cameras.width, cameras.height], dim=1)
        rounding = getattr(config, "downscale_rounding_mode", "floor")
        cameras.rescale_output_resolution(scaling_factor=1.0 / factor, scale_rounding_mode=rounding)
        sizes = torch.cat([cameras.width, cameras.height], dim=1)
        if (side := int(sizes.min())) < SMALLEST:
            raise InputError(f"{source}: --downscale-factor {factor} leaves {side} pixels a side. Give a smaller one.")
        if self.downscale_factor is None:
            self._check_sizes(meta, source, factor, full_sizes, sizes)
        whole = transform
        if "applied_transform" in meta:
            whole = transform @ to4x4(checks.applied_transform(meta, source).to(transform))
        elif self._colmap.exists():
            whole = transform @ to4x4(COLMAP_TO_FRAMES.to(transform))
        return DataSet(meta, source, splits, factor, cameras, transform, whole, scale)

    def _placed_cameras(self, meta: dict[str, Any], source: Path) -> tuple[Cameras, Tensor, float]:
        """The cameras [V] in full size, oriented, centred and scaled; the transform [3, 4] from the frames' world to
        theirs, before scaling; and the scale, also of what was applied before."""
        config, frames = self.config, meta["frames"]
        lenses = checks.read_lenses(meta, source)
        scaled = config.auto_scale_poses and len(frames) > 1
        poses = checks.check_poses(frames, source, need_spread=scaled)
        orientation = meta.get("orientation_override", config.orientation_method)
        needed = f"one of {', '.join(ORIENTATIONS)} (or remove it)"
        require(orientation in ORIENTATIONS, f"{source}: orientation_override", shown(repr(orientation)), needed)
        placed, transform, scale = place(poses, orientation, config.center_method, scaled, config.scale_factor)
        kind = CAMERA_MODEL_TO_TYPE[meta.get("camera_model", "OPENCV")]
        if kind == CameraType.FISHEYE:
            lenses[(lenses[:, len(PIXELS) :] == 0).all(axis=1), len(PIXELS)] = FISHEYE_AT_LEAST
        check_distortions(lenses, kind, frames, source)
        fx, fy, cx, cy, width, height = torch.from_numpy(lenses[:, : len(PIXELS)]).float().unbind(1)
        distortion = torch.from_numpy(lenses[:, len(PIXELS) :]).float()
        cameras = Cameras(placed, fx, fy, cx, cy, width.int(), height.int(), distortion, kind, metadata={})
        return cameras, transform, scale * checks.applied_scale(meta, source)

    def _factor(self, frames: list[dict[str, Any]], source: Path) -> int:
        """The downscale factor, given or by the images' size; InputError if a file is missing at that size."""
        factor = self.config.downscale_factor
        if factor is None:
            paths = [self._path(frame["file_path"]) for frame in frames]
            checks.check_exist(paths, source, "images")
            size, factor = max(read_size(paths[0])), 1
            while size / factor > MAX_AUTO_RESOLUTION and (
                self._resizes or self._path(frames[0]["file_path"], "file_path", 2 * factor).exists()
            ):
                factor *= 2
        for key in FOLDERS:
            kind = "images" if key == "file_path" else f"files of {key}"
            checks.check_exist(self._files(frames, key, factor), source, kind)
        return factor

    def _splits(self, meta: dict[str, Any], source: Path) -> Rows:
        """Rows of the training and the evaluation images, by the data set's own lists or by rule."""
        paths = [self._path(frame["file_path"]) for frame in meta["frames"]]
        named = self._named_splits(meta)
        if named and "train" not in named:
            given, _ = next(iter(named.values()))  # such as test_filenames or test_list.txt
            raise InputError(f"{source} has {given}, but no train_{given.partition('_')[2]}. Name the training images.")
        if named and (rule := self.config.eval_mode) != type(self.config).eval_mode:
            lists = ", ".join(name for name, _ in named.values())
            warn(f"--eval-mode {rule} changes nothing, since the data set has lists of images ({lists}): remove them.")
        splits = (
            split_by_names(named, paths, self._path, source) if named else split_by_rule(self.config, paths, source)
        )
        if not len(splits["train"]):
            raise InputError(f"{source}: no image left for training. Correct train_filenames or --eval-mode's options.")
        return splits

    def _files(self, frames: list[dict[str, Any]], key: str, factor: int) -> list[Path]:
        """Files of some frames, in full size or the data set's own smaller copies."""
        if key not in frames[0]:
            return []
        factor = factor if self._has_copies(key, factor) else 1
        return [self._path(frame[key], key, factor) for frame in frames]

    def _has_copies(self, key: str, factor: int) -> bool:
        return factor > 1 and self._copies(key, factor).is_dir()

    def _copies(self, key: str, factor: int) -> Path:
        """Folder of the copies at 1 / factor of the size, which need not be there."""
        root = self._root(key)
        return root.parent / f"{root.name}_{factor}"

    def _check_sizes(self, meta: dict[str, Any], source: Path, factor: int, full: Tensor, small: Tensor) -> None:
        """Check that images and masks have the size of their cameras, or the full one without smaller copies, [V, 2]
        each."""
        for key, kind in FOLDERS.items():
            paths = self._files(meta["frames"], key, factor)
            if paths and self._has_copies(key, factor):
                checks.check_unique(paths, f"{source}: frames")
                folder = self._copies(key, factor)
                fix = f"Remove {folder}, or with `colmap` give --downscale-rounding-mode round or ceil."
                checks.check_headers(paths, small.tolist(), kind, fix)
            elif paths:
                fix = "Use the images of the poses, or scale w, h, fl_x, fl_y, cx and cy with them; masks are as large."
                checks.check_headers(paths, full.tolist(), kind, fix)

    @cached_property
    def _placed_points(self) -> dict[str, Tensor]:
        """points3D_xyz float32 [N, 3] and points3D_rgb uint8 [N, 3] in the cameras' world; if too few, a warning."""
        data_set = self._data_set
        xyz, rgb, transform = *np.empty((2, 0, 3)), data_set.from_frames
        if "ply_file_path" in data_set.meta:
            xyz, rgb = read_ply(self._path(str(data_set.meta["ply_file_path"])))
        elif self._colmap.is_dir():
            xyz, rgb, transform = *finite(*read_points(self._colmap)), data_set.from_original
        if len(xyz) < MIN_POINTS:
            finding = f"there are {len(xyz)} usable points (of ply_file_path, or in colmap/sparse/0)"
            warn(f"{data_set.source}: {finding}. Training starts from random points, which costs quality.")
            return {}
        xyz, rgb, transform = torch.from_numpy(xyz), torch.from_numpy(rgb), transform.double()
        xyz = data_set.scale * (xyz @ transform[:, :3].T + transform[:, 3])
        near = torch.from_numpy(in_reach(xyz.numpy(), data_set.cameras, data_set.source))
        xyz, rgb = xyz[near].float(), rgb[near]
        rows = data_set.splits["train"]
        names = [data_set.meta["frames"][row]["file_path"] for row in rows]
        check_sight(xyz, data_set.cameras[torch.from_numpy(rows)], names, data_set.source)
        return {"points3D_xyz": xyz, "points3D_rgb": rgb}

    # Different for COLMAP models.

    def _read(self) -> tuple[dict[str, Any], Path]:
        """The data set as a transforms.json, checked by `check_frames`, its frames sorted by name for splitting, as
        in nerfstudio; and the file that messages name."""
        meta, source = read_transforms(self.config.data)
        checks.check_frames(meta["frames"], source)
        meta["frames"].sort(key=lambda frame: self._path(frame["file_path"]).parts)
        return meta, source

    @property
    def _folder(self) -> Path:
        data = self.config.data
        return data.parent if data.is_file() else data

    @property
    def _colmap(self) -> Path:
        """The COLMAP model that the poses come from; it need not be there."""
        return self._folder / "colmap" / "sparse" / "0"

    def _root(self, key: str) -> Path:
        """Folder of one kind of files in full size, beside which smaller copies are."""
        return self._folder / FOLDERS[key]

    def _path(self, name: str, key: str = "file_path", factor: int = 1) -> Path:
        """A file of a frame, or its copy at 1 / factor of the size, which need not be there."""
        return self._folder / name if factor == 1 else self._copies(key, factor) / Path(name).name

    def _named_splits(self, meta: dict[str, Any]) -> Named:
        """Splits listed by the data set itself."""
        fields = {split: f"{split}_filenames" for split in SPLITS}
        return {split: (name, meta[name]) for split, name in fields.items() if name in meta}


def place(
    poses: np.ndarray, orientation: str, centering: str, auto_scale: bool, factor: float
) -> tuple[Tensor, Tensor, float]:
    """Orient, centre and scale camera-to-world poses, float64 [V, 4, 4], as nerfstudio does.

    In float32, numbers near ten million are a metre apart. Cameras far from the origin, such as georeferenced ones, are
    therefore moved there in float64 first, and the way back is float64, too.

    Returns:
        The poses, float32 [V, 3, 4]; the transform [3, 4] before scaling, float64 if they were far from the origin and
        otherwise float32; and the scale.
    """
    if len(poses) < 3 and orientation == "vertical":  # needs three cameras
        orientation = "up"
    positions = poses[:, :3, 3]
    center = positions.mean(axis=0)
    extent = np.ptp(positions, axis=0).max()
    far = centering != "none" and np.abs(center).max() > FAR * extent > 0
    offset = rounded(center, extent) if far else np.zeros(3)
    near = poses.copy()
    near[:, :3, 3] -= offset
    moved = torch.from_numpy(near.astype(np.float32))
    with refusing("The cameras cannot be placed", "Give the parser --center-method poses.", RuntimeError):
        _, transform = auto_orient_and_center_poses(moved, method=orientation, center_method=centering)
    if not torch.isfinite(transform).all():
        raise InputError("The poses' up directions cancel. Give the parser --orientation-method none, or other poses.")
    placed = transform @ moved  # with pca nerfstudio turns the second and the third camera in place of two axes
    reach = float(torch.max(torch.abs(placed[:, :3, 3])))
    scale = (1.0 / reach if auto_scale and reach > 0 else 1.0) * factor
    placed[:, :3, 3] *= scale
    if far:
        transform = transform.double()
        transform[:, 3] -= transform[:, :3] @ torch.from_numpy(offset)
    return placed[:, :3, :4], transform, scale


def rounded(place: np.ndarray, extent: float) -> np.ndarray:
    """A place rounded to units, or to a power of two of the extent if that is less."""
    step = min(1.0, 2.0 ** np.floor(np.log2(extent)))
    return np.round(place / step) * step


def read_transforms(data: Path) -> tuple[dict[str, Any], Path]:
    """The content of the transforms.json of `data`, a folder or the file itself, with at least one frame; its path."""
    source = data if data.suffix == ".json" else data / "transforms.json"
    if not source.is_file():
        fix = (
            "Point --data at a folder that holds one; `nrfgs prepare PHOTOS SCENE` makes one from photographs. Where "
            "there is a transforms_train.json, put `blender-data` at the end of the command."
        )
        if data.is_dir() and (model := find_colmap(data)):
            fix = f"There is a COLMAP model: put `colmap --colmap-path {model}` at the end of the command."
        raise InputError(f"{source} is missing. {fix}")
    if source.stat().st_size > LONGEST_JSON:
        raise InputError(f"{source} is larger than {LONGEST_JSON} bytes. Make it anew.")
    fix = "Repair the file or make it anew."
    with refusing(f"{source} cannot be read as JSON", fix, OSError, ValueError, RecursionError):
        meta = json.loads(source.read_text(encoding="utf-8-sig"))
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source}: `frames` must be a non-empty list of objects. Make the file anew.")
    return meta, source


nrfgs_dataparser = DataParserSpecification(
    config=NrfgsDataParserConfig(),
    description="nerfstudio data, checked up front; every 8th image is for test; points without open3d.",
)
