# SPDX-License-Identifier: Apache-2.0
"""Where a data set keeps the files of its frames, and in which sizes."""

from pathlib import Path
from typing import Any

from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import MAX_AUTO_RESOLUTION

from nrfgs_ns.data.pictures import read_size

FOLDERS = {"file_path": "images", "mask_path": "masks", "depth_file_path": "depths"}
"""What a frame calls its image, mask and depths -> the folder of smaller copies, followed by _ and the factor."""


class Layout:
    """Of a data set with a transforms.json.

    Args:
        folder: that of transforms.json; frames name their files relative to it.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    @property
    def colmap(self) -> Path:
        """Where the COLMAP model is that the poses come from; it need not be there."""
        return self.folder / "colmap" / "sparse" / "0"

    def file(self, name: str, key: str = "file_path") -> Path:
        """A file that a frame names, in full size."""
        return self.folder / name

    def copy(self, name: str, key: str, factor: int) -> Path:
        """Its copy at 1 / factor of the size, which need not be there."""
        return self._copies(key, factor) / Path(name).name

    def has_copies(self, key: str, factor: int) -> bool:
        """Whether the data set has copies of its own at 1 / factor of the size."""
        return factor > 1 and self._copies(key, factor).is_dir()

    def files(self, frames: list[dict[str, Any]], key: str, factor: int) -> list[Path]:
        """The files of some frames, in full size or, where the data set has copies of the size wanted, those."""
        names = [frame[key] for frame in frames if key in frame]
        copies = names and self.has_copies(key, factor)
        return [self.copy(name, key, factor) if copies else self.file(name, key) for name in names]

    def factor_of(self, image: str) -> int:
        """The smallest power of two that leaves an image no side longer than 1600 pixels, among those that may be taken
        without having been asked for."""
        size, factor = max(read_size(self.file(image))), 1
        while size / factor > MAX_AUTO_RESOLUTION and self._may_be_taken(image, 2 * factor):
            factor *= 2
        return factor

    def _may_be_taken(self, image: str, factor: int) -> bool:
        return self.copy(image, "file_path", factor).exists()

    def _root(self, key: str) -> Path:
        """The folder of one kind of files, in full size."""
        return self.folder / FOLDERS[key]

    def _copies(self, key: str, factor: int) -> Path:
        root = self._root(key)
        return root.with_name(f"{root.name}_{factor}")


class ColmapLayout(Layout):
    """Of a folder that nerfstudio's `colmap` parser reads: copies of every size are made where there are none."""

    def __init__(self, config: ColmapDataParserConfig):
        super().__init__(config.data)
        self.config = config

    @property
    def colmap(self) -> Path:
        return self.folder / self.config.colmap_path

    def file(self, name: str, key: str = "file_path") -> Path:
        path = self._root(key) / name
        return path if key == "file_path" else path.with_suffix(".png")

    def copy(self, name: str, key: str, factor: int) -> Path:
        return self._copies(key, factor) / self.file(name, key).relative_to(self._root(key))

    def _may_be_taken(self, image: str, factor: int) -> bool:
        return True

    def _root(self, key: str) -> Path:
        config = self.config
        folders = {
            "file_path": config.images_path,
            "mask_path": config.masks_path,
            "depth_file_path": config.depths_path,
        }
        return self.folder / folders[key]
