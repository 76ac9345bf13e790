# SPDX-License-Identifier: Apache-2.0
"""Whether a training learns what happened to each photograph, and from where it starts.

It does if the capture needs it: if EXIF says that exposure varies, or if photographs disagree about the same points by
more than their places explain (`image/overlap.py`). What they say is where it starts.
"""

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from nrfgs_ns.data.pictures import read_exif
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.overlap import (
    ENOUGH_STOPS,
    Looks,
    Pairs,
    Sighting,
    channels,
    compare,
    drawn,
    estimate,
    sight,
    slope,
    spread,
    varies,
)
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.model.pinhole import world_to_camera

Choice = Literal["auto", "on", "off"]
Exif = dict[str, Any]


class Evidence(NamedTuple):
    """What is known of V photographs before a training."""

    pairs: Pairs
    centers: Tensor
    """where they were taken, [V, 3]"""
    known: Tensor
    """exposures from EXIF in stops, NaN where it says nothing, [V]"""
    seen: Looks
    """what the pairs say by themselves"""

    @property
    def learnt_by_itself(self) -> bool:
        """Whether exposure and white balance are learnt unless somebody says otherwise.

        EXIF's exposure counts as far as the photographs' brightness follows it: one that the light or the camera's own
        tone curve makes up for does not show.
        """
        vary = any(size >= enough for size, enough in zip(self.seen.random, ENOUGH_STOPS, strict=True))
        followed, _ = slope(self.pairs, self.known)
        return vary or varies(self.known) and followed * spread(self.known) >= ENOUGH_STOPS[0]


def evidence(datamanager: Any) -> Evidence:
    """Compare a training's photographs, whose images have been read."""
    dataset = datamanager.train_dataset
    told = datamanager.train_dataparser_outputs.metadata
    exif = exif_of(dataset.image_filenames, told.get("exif"))
    known = torch.tensor([exposure(of_one) for of_one in exif])
    pairs = compare_photographs(told.get("points3D_xyz"), dataset.cameras, datamanager.cached_train)
    centers = dataset.cameras.camera_to_worlds[:, :3, 3].cpu()
    return Evidence(pairs, centers, known, estimate(pairs, torch.full_like(known, torch.nan), centers))


def photograph_model(config: Any, datamanager: Any) -> tuple[PhotographModel | None, list[str]]:
    """The photographs' exposure model, announced in one line.

    Args:
        config: an NrfgsModelConfig.
        datamanager: with its images read.

    Returns:
        The model, None where nothing is learnt; and the evidence in words and numbers.

    Raises:
        InputError: it is asked for together with the bilateral grid.
    """
    if config.photographs == "off":
        return None, []
    if config.use_bilateral_grid:
        if config.photographs == "on":
            raise InputError(
                "pipeline.model.photographs is on and use_bilateral_grid, too: both would learn the same. Use one."
            )
        return None, []
    found = evidence(datamanager)
    wanted, why = verdict(config.photographs, found)
    outcome = f"exposure and white balance {'learnt' if wanted else 'not learnt'}"
    CONSOLE.print(f"Photographs: {outcome}, {reason(config.photographs, found)}.", soft_wrap=True)
    notes = [f"photographs: {outcome}: {why}"]
    if not wanted:
        return None, notes
    known = found.known
    looks = estimate(found.pairs, known, found.centers) if torch.isfinite(known).any() else found.seen
    names = [path.name for path in datamanager.train_dataset.image_filenames]
    return PhotographModel(names, channels(looks.stops), looks.held), notes


def reason(choice: Choice, found: Evidence) -> str:
    """Why photographs' exposure is learnt or not, in a few words."""
    if choice == "on":
        return "as asked for"
    if found.learnt_by_itself:
        return "since the photographs differ in brightness or colour"
    return "since the photographs agree" if any(found.seen.random) else "since too few common points compare them"


def verdict(choice: Choice, found: Evidence) -> tuple[bool, str]:
    """Whether a training learns photographs' exposure, and why, in words."""
    pairs, known = found.pairs, found.known
    exposures, *colors = found.seen.random
    words = f"exposure varies by {exposures:.2f} stops, colour by {max(colors):.2f}"
    if not any(found.seen.random):
        words = "photographs have too few points in common to compare them"
    needed = found.learnt_by_itself
    if not needed:
        words += f" (learnt from {ENOUGH_STOPS[0]:g}, or {ENOUGH_STOPS[1]:g} in colour)"
    if not torch.isfinite(known).any():
        words += "; EXIF has no exposures"
    elif not varies(known):
        words += f"; EXIF: {'the same' if spread(known) < 0.005 else 'almost the same'} exposure"
    else:
        words += f"; EXIF: exposure varies by {spread(known):.2f} stops"
        _, explained = slope(pairs, known)
        if explained is not None:
            words += f", which explains {explained:.0%} of the difference"
    return needed or choice == "on", "option photographs is on; " * (choice == "on") + words


def check_same_photographs(own: PhotographModel | None, written: Mapping[str, Any] | None) -> None:
    """Raise InputError where a training goes on that had learnt other photographs.

    Args:
        own: of the training that goes on.
        written: what the checkpoint says of its own, None if it learnt none.
    """
    if (own is None) != (written is None):
        theirs, ours = ("on", "off") if own is None else ("off", "on")
        raise InputError(
            f"The checkpoint was trained with photographs {theirs}, this training has them {ours}. Set "
            f"--pipeline.model.photographs {theirs}, or train anew."
        )
    if own is not None and own.names != written["names"]:
        raise InputError("The checkpoint was trained on other photographs. Go on with the same ones, or train anew.")


def exif_of(paths: Sequence[Path], stored: Sequence[Exif] | None) -> list[Exif]:
    """What the data set says of each photograph, or else its file. [V]"""
    return [told or read_exif(path) for path, told in zip(paths, stored or [{}] * len(paths), strict=True)]


def exposure(exif: Exif) -> float:
    """A photograph's exposure in stops, up to a constant; NaN if it cannot be told."""
    if "exposure_time" not in exif or "iso" not in exif:
        return float("nan")
    return math.log2(exif["exposure_time"]) + math.log2(exif["iso"]) - 2 * math.log2(exif.get("f_number", 1.0))


def compare_photographs(points: Tensor | None, cameras: Cameras, images: Sequence[Mapping[str, Any]]) -> Pairs:
    """Compare photographs at the points that they share.

    Args:
        points: of the reconstruction, [N, 3]; None: there are none.
        cameras: [V].
        images: "image" [H, W, 3 or 4] and perhaps "mask" [H, W, 1] of each. [V]
    """
    centers = cameras.camera_to_worlds[:, :3, 3].cpu()
    if points is None or len(points) == 0:
        return compare([], centers[:0])
    points = drawn(points)
    viewmats = world_to_camera(cameras.camera_to_worlds)
    matrices = cameras.get_intrinsics_matrices()

    def seen(viewmat: Tensor, K: Tensor, batch: Mapping[str, Any]) -> Sighting:
        image, mask = batch["image"], None
        if image.shape[-1] == 4:
            mask, image = image[..., 3] >= (128 if image.dtype == torch.uint8 else 0.5), image[..., :3]
        if "mask" in batch:
            inside = batch["mask"][..., 0] >= 0.5
            mask = inside if mask is None else mask & inside.to(mask.device)
        return sight(points, viewmat, K, image, mask)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        sightings = list(pool.map(seen, viewmats, matrices, images))
    return compare(sightings, centers)
