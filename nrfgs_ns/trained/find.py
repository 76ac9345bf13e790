# SPDX-License-Identifier: Apache-2.0
"""The training that a command line names, found before torch is imported."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from nrfgs_ns.errors import InputError

OUTPUTS = Path("outputs")
"""Where ns-train writes by default"""


@dataclass
class NamesTraining:
    """Options that name a trained model."""

    model: tyro.conf.Positional[Path | None] = None
    """config.yml of a training, or a folder, of whose trainings the newest with a checkpoint counts. None: outputs"""
    load_config: Path | None = None
    """the same, as ns-eval and ns-viewer call it"""

    def config(self) -> Path:
        """The named config.yml (`config_of`); InputError if two are named."""
        if self.model is not None and self.load_config is not None:
            raise InputError(f"{self.model} and --load-config {self.load_config} both name a training. Give one.")
        return config_of(self.model if self.load_config is None else self.load_config)


def config_of(path: Path | None) -> Path:
    """The file at a path, or the newest config.yml in a folder (None: outputs) or up to three levels below it, of those
    with checkpoints if there are any, which is printed; InputError without one."""
    if path is not None and path.is_file():
        return path
    folder = OUTPUTS if path is None else path
    if not folder.is_dir():
        missing = "there is no folder outputs here" if path is None else f"{path}: no such file or folder"
        raise InputError(f"{missing}. Name the config.yml of a training, or its folder.")
    configs = [config for depth in range(4) for config in folder.glob("*/" * depth + "config.yml")]
    if not configs:
        raise InputError(f"{folder}: no config.yml in this folder or below. Name the folder of a training.")

    def order(config: Path) -> tuple[bool, bool, float]:
        # One of a compact file (`export.compact.write_config`) is newer than that of the training it was made from.
        is_compact = config.match("*.nerfstudio/*/compact/config.yml")
        return any(config.parent.glob("*/step-*.ckpt")), not is_compact, config.stat().st_mtime

    newest = max(configs, key=order)
    print(f"Training: {newest}", flush=True)
    return newest
