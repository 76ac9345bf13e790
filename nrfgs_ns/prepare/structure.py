# SPDX-License-Identifier: Apache-2.0
"""Cameras and sparse points from photographs: SIFT, matching, incremental mapping and undistortion, by pycolmap.

Every step takes up what an interrupted run has left: features and matches are kept in COLMAP's database, which skips
what it has. Which pairs are matched is decided here, not by COLMAP:

    exhaustive  every pair
    sequential  each photograph with its NEIGHBOURS successors, and with those 16, 32, ... 512 further on (a camera that
                moves slowly); and every pair among LANDMARKS of them, spread evenly over the row, which closes loops
"""

import itertools
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from nrfgs_ns.errors import InputError

Matching = Literal["exhaustive", "sequential"]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

EXHAUSTIVE_UP_TO = 100
"""Photographs of which every pair is matched: 4,950 pairs."""
NEIGHBOURS = 10
LANDMARKS = 40
NUMBERED_SHARE = 0.9
"""Share of neighbours by name whose numbers must follow each other closely for a folder to look like one walk."""
LARGEST_GAP = 3
"""Numbers that differ by no more follow each other closely: a blurred photograph or two may have been thrown away."""
PAIRS_AT_ONCE = 64
"""Pairs handed to COLMAP together: between them progress is shown, and an interruption loses no more."""
SEED = 0

Advance = Callable[[int], None]


def colmap():
    """The module pycolmap, which is told to say nothing: what went wrong is told here.

    Raises:
        InputError: it is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"`nrfgs prepare` needs pycolmap, which cannot be imported ({error}). Run `pip install pycolmap`."
        ) from error
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(SEED)
    return pycolmap


def choose_matching(names: list[str], is_video: bool) -> Matching:
    """Exhaustive for up to 100 images. More are matched in sequence if they are the frames of a video, or if nine in
    ten neighbours by name have numbers that differ by at most three; and exhaustively otherwise."""
    if len(names) <= EXHAUSTIVE_UP_TO:
        return "exhaustive"
    numbers = [re.findall(r"\d+", Path(name).stem) for name in names]
    steps = [int(b[-1]) - int(a[-1]) if a and b else 0 for a, b in itertools.pairwise(numbers)]
    close = sum(1 <= step <= LARGEST_GAP for step in steps)
    return "sequential" if is_video or close >= NUMBERED_SHARE * len(steps) else "exhaustive"


def pairs_of(count: int, matching: Matching) -> list[tuple[int, int]]:
    """Pairs of indices to be matched, each once, first < second, sorted."""
    if matching == "exhaustive":
        return list(itertools.combinations(range(count), 2))
    steps = {*range(1, NEIGHBOURS + 1), *(2**power for power in range(NEIGHBOURS))}
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    landmarks = sorted({round(i * (count - 1) / (LANDMARKS - 1)) for i in range(LANDMARKS)})
    return sorted(pairs | set(itertools.combinations(landmarks, 2)))


def extract_features(
    database: Path,
    photos: Path,
    names: list[str],
    camera_model: CameraModel,
    one_camera: bool,
    longest_side: int,
    features: int,
    advance: Advance,
) -> None:
    """SIFT features of every photograph, on the CPU.

    Args:
        one_camera: all photographs share their intrinsics.
        longest_side: larger photographs are shrunk for this step only, pixels.
        features: at most so many in a photograph.
        advance: called with the number of photographs that were done.
    """
    pycolmap = colmap()
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = longest_side
    options.sift.max_num_features = features
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    batch = max(os.cpu_count() or 1, 4)
    for first in range(0, len(names), batch):
        part = names[first : first + batch]
        if one_camera and first > 0:
            reader.existing_camera_id = 1  # each call would make a camera of its own
        pycolmap.extract_features(
            database,
            photos,
            image_names=part,
            camera_mode=pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.PER_IMAGE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        advance(len(part))


def match_features(database: Path, names: list[str], matching: Matching, folder: Path, advance: Advance) -> int:
    """Match and verify pairs of photographs.

    Args:
        folder: for the list of pairs that COLMAP reads.
        advance: called with the number of pairs that were done.

    Returns:
        How many pairs show the same thing.
    """
    pycolmap = colmap()
    pairs = pairs_of(len(names), matching)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    for first in range(0, len(pairs), PAIRS_AT_ONCE):
        part = pairs[first : first + PAIRS_AT_ONCE]
        lines = [f"{names[a]} {names[b]}\n" for a, b in part]
        (folder / "pairs.txt").write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(database, pairing_options=pairing, device=pycolmap.Device.cpu)
        advance(len(part))
    with pycolmap.Database.open(database) as opened:
        _, inliers = opened.read_two_view_geometry_num_inliers()
        return sum(number > 0 for number in inliers)


def map_incrementally(database: Path, photos: Path, folder: Path, advance: Advance) -> int:
    """Cameras and points; the largest model is written to `folder`.

    Args:
        advance: called with 1 for each photograph that found its place.

    Returns:
        How many separate models were found; 0 if none, and then nothing is written.
    """
    pycolmap = colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.random_seed = SEED
    attempts = folder.with_name(folder.name + ".attempts")
    for path in (attempts, folder):
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
    models = pycolmap.incremental_mapping(
        database,
        photos,
        attempts,
        options=options,
        initial_image_pair_callback=lambda: advance(2),
        next_image_callback=lambda: advance(1),
    )
    if models:
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
        best.write(folder)
    shutil.rmtree(attempts)
    return len(models)


def undistort(model: Path, photos: Path, folder: Path) -> None:
    """Undistorted photographs in folder/images, and their pinhole model in folder/sparse."""
    pycolmap = colmap()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pycolmap.undistort_images(folder, model, photos, output_type="COLMAP", jpeg_quality=97)
