# SPDX-License-Identifier: Apache-2.0
"""nerfstudio's `colmap` parser with the checks of `nrfgs-data`, and the parsers in place of nerfstudio's."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from nrfgs_ns.data.checks import check_frames
from nrfgs_ns.data.colmap import read_frames
from nrfgs_ns.data.dataparser import NrfgsDataParser
from nrfgs_ns.data.splits import Named
from nrfgs_ns.errors import InputError, refusing

UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""nerfstudio's turn of COLMAP's world, whose y points downwards, to one whose z points upwards."""
LISTS = (("train", "train"), ("val", "val"), ("val", "validation"), ("test", "test"))
"""Parts of a data set, and the beginning of the file ..._list.txt that may name their images."""


class NrfgsColmapDataParser(NrfgsDataParser):
    """nerfstudio's `colmap` parser, with the checks of `NrfgsDataParser` and without questions at the terminal: images
    larger than 1600 pixels are resized by a power of two, as nerfstudio proposes."""

    config: ColmapDataParserConfig
    _resizes = True

    def _read(self) -> tuple[dict[str, Any], Path]:
        config = self.config
        frames, source = read_frames(self._colmap)
        kinds = {frame["camera_model"] for frame in frames}
        if len(kinds) > 1:
            raise InputError(f"{source}: some cameras are fisheyes and some are not. Undistort the photographs.")
        upright = UPRIGHT if config.assume_colmap_world_coordinate_convention else np.eye(4)
        for frame in frames:
            frame["transform_matrix"] = upright @ frame["transform_matrix"]
            if config.masks_path is not None:
                frame["mask_path"] = frame["file_path"]
        check_frames(frames, source)
        return {"frames": frames, "camera_model": kinds.pop(), "applied_transform": upright[:3].tolist()}, source

    @property
    def _colmap(self) -> Path:
        return self._folder / self.config.colmap_path

    def _root(self, key: str) -> Path:
        return self._folder / (self.config.images_path if key == "file_path" else self.config.masks_path)

    def _path(self, name: str, key: str = "file_path", factor: int = 1) -> Path:
        path = (self._root(key) if factor == 1 else self._copies(key, factor)) / name
        return path if key == "file_path" else path.with_suffix(".png")

    def _named_splits(self, meta: dict[str, Any]) -> Named:
        named = {}
        for split, file in LISTS:
            path = self._folder / f"{file}_list.txt"
            if path.is_file():
                with refusing(f"{path} cannot be read", "Write one image name on each line.", OSError, ValueError):
                    lines = path.read_text(encoding="utf-8").splitlines()
                named[split] = path.name, [line.strip() for line in lines if line.strip()]
        return named


def checked(config: DataParserConfig) -> DataParserConfig:
    """A parser's configuration; nerfstudio's own two become our parsers'."""
    parsers = {NerfstudioDataParserConfig: NrfgsDataParser, ColmapDataParserConfig: NrfgsColmapDataParser}
    return replace(config, _target=parsers[type(config)]) if type(config) in parsers else config
