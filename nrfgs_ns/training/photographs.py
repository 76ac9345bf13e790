# SPDX-License-Identifier: Apache-2.0
"""Whether a training learns each photograph's exposure and white balance, and from which start: it does if EXIF says
that exposure varies, or if photographs disagree about the same points by more than their places explain
(`image/overlap.py`).
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from nrfgs_ns.data.pictures import picture_names, read_exif
from nrfgs_ns.image import overlap
from nrfgs_ns.image.overlap import ENOUGH_KNOWN_STOPS, ENOUGH_STOPS, Looks, Pairs, estimate, slope, spread
from nrfgs_ns.image.photograph import PhotographModel
from nrfgs_ns.rasterizer import world_to_camera

Exif = dict[str, Any]


def they_differ(pairs: Pairs, exif: Tensor, seen: Looks) -> bool:
    """Whether V photographs differ so much that exposure and white balance are learnt unless an option decides.

    EXIF's exposure counts as far as the photographs' brightness follows it: a change that the light or the camera's own
    tone curve makes up for does not show.

    Args:
        exif: exposures from EXIF in stops, NaN where it says nothing, [V].
        seen: exposures from the pairs alone.
    """
    vary = any(size >= enough for size, enough in zip(seen.random, ENOUGH_STOPS, strict=True))
    known = spread(exif)
    return vary or known >= ENOUGH_KNOWN_STOPS and slope(pairs, exif) * known >= ENOUGH_STOPS[0]


def photograph_model(config: Any, datamanager: Any) -> PhotographModel | None:
    """The photographs' exposure model, announced in one line; None where nothing is learnt.

    Args:
        config: an NrfgsModelConfig.
        datamanager: with its images read.
    """
    choice = config.photographs
    if choice == "off":
        return None
    dataset = datamanager.train_dataset
    metadata = datamanager.train_dataparser_outputs.metadata
    exif = exposures(exif_of(dataset.image_filenames, metadata.get("exif")))
    pairs = compare_photographs(metadata.get("points3D_xyz"), dataset.cameras, datamanager.cached_train)
    centers = dataset.cameras.camera_to_worlds[:, :3, 3].cpu()
    seen = estimate(pairs, torch.full_like(exif, torch.nan), centers)
    wanted = choice == "on" or they_differ(pairs, exif, seen)
    outcome = f"exposure and white balance {'learnt' if wanted else 'not learnt'}"
    if choice == "on":
        reason = "as requested"
    elif wanted:
        reason = "since the photographs differ in brightness or colour"
    else:
        reason = f"since {'the photographs agree' if any(seen.random) else 'too few common points compare them'}"
    CONSOLE.print(f"Photographs: {outcome}, {reason}.", soft_wrap=True)
    if not wanted:
        return None
    looks = estimate(pairs, exif, centers) if torch.isfinite(exif).any() else seen
    return PhotographModel(picture_names(dataset.image_filenames), looks.stops, looks.held)


def exif_of(paths: Sequence[Path], stored: Sequence[Exif] | None) -> list[Exif]:
    """EXIF of each photograph from the data set, or else from its file. [V]"""
    return [entry or read_exif(path) for path, entry in zip(paths, stored or [{}] * len(paths), strict=True)]


def exposures(exif: Sequence[Exif]) -> Tensor:
    """Photographs' exposures in stops, up to a constant; NaN where unknown. Those with and those without an aperture,
    as of manual lenses, cannot be compared: the fewer are unknown. [V]"""
    stops = torch.tensor([exposure(entry) for entry in exif])
    has_aperture = torch.tensor(["f_number" in entry for entry in exif])
    most_have = bool(has_aperture[torch.isfinite(stops)].double().mean() >= 0.5)
    return stops.where(has_aperture == most_have, torch.nan)


def exposure(exif: Exif) -> float:
    """A photograph's exposure in stops, up to a constant; NaN if unknown."""
    if "exposure_time" not in exif or "iso" not in exif:
        return math.nan
    return math.log2(exif["exposure_time"]) + math.log2(exif["iso"]) - 2 * math.log2(exif.get("f_number", 1.0))


def compare_photographs(points: Tensor | None, cameras: Cameras, images: Sequence[Mapping[str, Any]]) -> Pairs:
    """Compare V photographs at the reconstruction's points [N, 3], if it has any.

    Args:
        images: "image" [H, W, 3 or 4] and perhaps "mask" [H, W, 1] of each photograph.
    """
    centers = cameras.camera_to_worlds[:, :3, 3].cpu()
    if points is None or len(points) == 0:
        return overlap.compare([], centers[:0])
    points = overlap.drawn(points)

    def seen(viewmat: Tensor, K: Tensor, batch: Mapping[str, Any]) -> overlap.Sighting:
        image = batch["image"]
        mask = None
        if image.shape[-1] == 4:
            mask = image[..., 3] >= (128 if image.dtype == torch.uint8 else 0.5)
            image = image[..., :3]
        if "mask" in batch:
            inside = batch["mask"][..., 0] >= 0.5
            mask = inside if mask is None else mask & inside.to(mask.device)
        return overlap.sight(points, viewmat, K, image, mask)

    with ThreadPoolExecutor(4) as pool:  # more would wait for Python's lock
        viewmats = world_to_camera(cameras.camera_to_worlds)
        sightings = list(pool.map(seen, viewmats, cameras.get_intrinsics_matrices(), images))
    return overlap.compare(sightings, centers)
