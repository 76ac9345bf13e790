# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: written whole or not at all, and read only if they are what was written.

torch's files are zip archives with a CRC of each record, which torch does not check: a flipped bit loads as another
model. `read` checks every byte, in 0.3 s for 500 MB.
"""

import os
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nrfgs_ns.data.checks import warn
from nrfgs_ns.errors import ForTheUser, InputError, refusing

NAME = re.compile(r"step-(\d{9,})\.ckpt")
"""Names of checkpoints; other files in the folder are ignored."""
KEPT = 2
"""Checkpoints to keep: if the last one is damaged, the one before is read."""


class DiskFull(ForTheUser, RuntimeError):
    """A checkpoint could not be written: no space, a quota, or a limit on file sizes."""


def allow_nerfstudio_checkpoints() -> None:
    """Let `torch.load(weights_only=True)` read numpy scalars, plain data in the state of nerfstudio's schedulers."""
    scalar = np._core.multiarray.scalar
    older = scalar, "numpy.core.multiarray.scalar"
    torch.serialization.add_safe_globals([scalar, older, np.dtype, np.dtypes.Float64DType])


def find(folder: Path) -> dict[int, Path]:
    """Checkpoints in a folder by step, the newest first; empty if there is no folder."""
    by_step = {int(match[1]): file for file in folder.glob("*") if (match := NAME.fullmatch(file.name))}
    return dict(sorted(by_step.items(), reverse=True))


def write(folder: Path, step: int, content: dict[str, Any], only_latest: bool = True) -> Path:
    """Write a checkpoint beside its folder, sync it, move it in, and remove older ones; DiskFull where that fails."""
    folder.mkdir(parents=True, exist_ok=True)
    final = folder / f"step-{step:09d}.ckpt"
    # Beside the folder: nerfstudio's commands take every file within for a checkpoint. By a name that the next write
    # uses again, if this process is killed.
    unfinished = folder.with_name(f"{folder.name}.writing")
    try:
        torch.save(content, unfinished)
        _sync(unfinished)
        os.replace(unfinished, final)
        _sync(folder)
    except (OSError, RuntimeError) as error:  # torch raises RuntimeError without the system's reason
        if isinstance(error, torch.OutOfMemoryError):
            raise
        reason = getattr(error, "strerror", None) or "the disk is full or a limit reached"
        free = shutil.disk_usage(folder).free / 1e6
        kept = next(iter(find(folder).values()), "none")
        raise DiskFull(
            f"{folder}: the checkpoint of step {step} cannot be written: {reason}. {free:,.0f} MB are free. The last "
            f"one: {kept}. Make room, or lift the quota or the limit on file sizes (ulimit -f)."
        ) from error
    finally:
        unfinished.unlink(missing_ok=True)
    if only_latest:
        for older in list(find(folder).values())[KEPT:]:
            older.unlink(missing_ok=True)
    return final


def read(path: Path) -> dict[str, Any]:
    """Read a checkpoint into host memory; InputError where a byte is not as it was written, or it is gone."""
    allow_nerfstudio_checkpoints()
    # Damage to a zip archive, or to a pickle in it, can raise anything.
    with refusing(f"{path} is damaged", "Restore it from a copy, or take another one.", Exception):
        with zipfile.ZipFile(path) as archive:
            if (bad := archive.testzip()) is not None:
                raise ValueError(f"the checksum of its record {bad} is wrong")
        content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content, dict) or not {"step", "pipeline"} <= content.keys():
            raise ValueError("it is not a checkpoint of nerfstudio")
        return content


def read_latest(folder: Path, step: int | None = None) -> tuple[Path, dict[str, Any]]:
    """Read a folder's last checkpoint, or a step's; if the last is damaged the one before, with a warning. InputError
    if none can be read."""
    checkpoints = checkpoints_in(folder)
    if step is not None:
        if step not in checkpoints:
            raise InputError(f"{folder} has no checkpoint of step {step}, only of {', '.join(map(str, checkpoints))}.")
        checkpoints = {step: checkpoints[step]}
    damages: list[str] = []
    for path in checkpoints.values():
        try:
            content = read(path)
        except InputError as damage:
            damages.append(str(damage))
        else:
            if damages:
                warn(f"{' '.join(damages)} Taking the one before, {path.name}.")
            return path, content
    raise InputError(" ".join(damages))


def checkpoints_in(folder: Path) -> dict[int, Path]:
    """As `find`, with an InputError where there are none."""
    checkpoints = find(folder)
    if checkpoints:
        return checkpoints
    within = next((inner.parent for inner in sorted(folder.glob("*/step-*.ckpt"))), None)
    fix = f"They are in {within}." if within else "Give the folder nerfstudio_models of a training."
    raise InputError(f"{folder} holds no checkpoints (step-*.ckpt). {fix}")


def _sync(path: Path) -> None:
    """Flush a file, or a folder's list of files, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
