# SPDX-License-Identifier: Apache-2.0
"""Cameras and sparse points from photographs: SIFT, matching, mapping and undistortion, by pycolmap.

COLMAP's database keeps features and matches, so that an interrupted step continues.
"""

import itertools
import math
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import ExifTags

from nrfgs_ns.data.pictures import exif_of, open_picture, read_size, tag_number
from nrfgs_ns.errors import InputError, refusing
from nrfgs_prepare.pairs import Advance, Pairs

Say = Callable[[str], None]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

LARGE = 1.5e6
"""Pixels from which a photograph has enough features without being doubled, at four times the cost."""
PAIRS_AT_ONCE = 64
"""Pairs between two updates of the progress; an interruption loses no more."""
SMALLEST_MODEL = 3
"""Minimum number of photographs of a model."""
FEWEST_POINTS = 10
"""Minimum number of points per photograph of a globally mapped model."""
RATIO, DOUBTFUL = 0.8, 0.9
"""Largest distance of a feature's best match, in distances of its second best: usually, and of few photographs that are
not all placed otherwise."""
FEW = 30
"""Few photographs: one that is not placed is worth another try with all pairs, and global mapping is mostly wrong."""
SEED = 0
EXPLAINED = 0.6
"""Minimum share of a photograph's matches that a right camera explains. In 15 models of six captures, right within 5 %
of the cameras' mean distance, each photograph had at least 0.78; in nine of four captures, with a camera off by half of
it or more, the lowest had at most 0.47 (results/prepare.json, `contradicted`)."""
BYTES_PER_FEATURE = 300
"""Room for a feature and its matches in the database."""
BYTES_PER_PIXEL = 1.0
"""Room for an undistorted photograph: JPEG of its quality takes up to 0.8."""
LONGEST_SIDE = 1600
"""Longest side of the images in which features are found, pixels."""


def colmap():
    """The module pycolmap, silenced; InputError if it is not installed."""
    finding = "`nrfgs prepare` needs pycolmap, which cannot be imported"
    with refusing(finding, "Run `pip install pycolmap`.", ImportError):
        import pycolmap
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(SEED)
    return pycolmap


def extract_features(
    database: Path, photos: Path, cameras: list[list[str]], advance: Advance, camera_model: CameraModel, features: int
) -> None:
    """Find at most `features` SIFT features in every photograph, on the CPU; each of `cameras` is a list of photographs
    that share their intrinsics. InputError where the disk lacks room for what follows: COLMAP would abort the whole
    process, or say nothing."""
    pycolmap = colmap()
    database.parent.mkdir(exist_ok=True)
    every = list(itertools.chain(*cameras))
    kept = database.stat().st_size if database.exists() else 0  # of an interrupted run
    pixels = sum(math.prod(read_size(photos / name)) for name in every)
    needed = BYTES_PER_FEATURE * features * len(every) + BYTES_PER_PIXEL * pixels - kept
    if needed > (free := shutil.disk_usage(database.parent).free):
        finding = f"the work may take {needed / 1e6:.1f} MB, and {free / 1e6:.1f} MB are free"
        raise InputError(f"{database.parent}: {finding}. Make room, or give a smaller --features.")
    options = pycolmap.FeatureExtractionOptions(max_image_size=LONGEST_SIDE)
    options.sift.max_num_features = features
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    batch = max(os.cpu_count() or 1, 4)
    alone = [names[0] for names in cameras if len(names) == 1]
    for names in (alone, *(names for names in cameras if len(names) > 1)):
        for first in range(0, len(names), batch):
            part = names[first : first + batch]
            sizes = [read_size(photos / name) for name in part]
            searched = min(w * h * min(1.0, LONGEST_SIDE / max(w, h)) ** 2 for w, h in sizes)
            options.sift.first_octave = 0 if searched >= LARGE else -1  # -1: the photograph is doubled first
            if names is not alone:  # each call would make a camera of its own
                with pycolmap.Database.open(database) as opened:
                    known = opened.read_image_with_name(names[0])
                reader.existing_camera_id = known.camera_id if known else -1
            pycolmap.extract_features(
                database,
                photos,
                image_names=part,
                camera_mode=pycolmap.CameraMode.PER_IMAGE if names is alone else pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            advance(len(part))
    _scale_focal_lengths(database, photos, every)


def _scale_focal_lengths(database: Path, photos: Path, names: list[str]) -> None:
    """Correct COLMAP's focal lengths by EXIF for photographs that were made smaller."""
    with colmap().Database.open(database) as opened:
        images = {name: opened.read_image_with_name(name) for name in names}
        unread = [name for name, image in images.items() if image is None]
        if unread:
            raise InputError(f"{photos / unread[0]} is left out by COLMAP. Save it anew as JPEG or PNG, or remove it.")
        cameras = {image.camera_id: name for name, image in images.items()}
        for number, name in cameras.items():
            camera = opened.read_camera(number)
            share = share_of_size(photos / name)
            if camera.has_prior_focal_length and share != 1.0:
                params = camera.params
                params[camera.focal_length_idxs()] *= share
                camera.params = params
                opened.update_camera(camera)


def share_of_size(path: Path) -> float:
    """Width of an image over its width in EXIF, to which the sensor's resolution refers; 1 where COLMAP needs or knows
    neither of them."""
    with open_picture(path) as image:
        exif, size = exif_of(image), image.size
    details = exif.get_ifd(ExifTags.IFD.Exif)
    sides = [tag_number(details.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    needed = ExifTags.Base.FocalPlaneXResolution in details and ExifTags.Base.FocalLengthIn35mmFilm not in details
    return max(size) / max(sides) if needed and None not in sides else 1.0


def largest_features(database: Path, names: list[str], number: int) -> list[np.ndarray]:
    """Descriptors [n <= number, 128] uint8 of each photograph, largest feature first."""
    found = []
    with colmap().Database.open(database) as opened:
        for name in names:
            image = opened.read_image_with_name(name)
            shapes = np.asarray(opened.read_keypoints(image.image_id))  # x, y and a matrix [2, 2] by rows
            descriptors = np.asarray(opened.read_descriptors(image.image_id).data).reshape(-1, 128)
            sizes = np.hypot(shapes[:, 2], shapes[:, 4]) if len(shapes) else np.zeros(0)
            found.append(descriptors[np.argsort(-sizes, kind="stable")[:number]])
    return found


def positions(database: Path, names: list[str]) -> np.ndarray:
    """Latitudes and longitudes of photographs in degrees, [N, 2], NaN where EXIF has no position with an altitude."""
    with colmap().Database.open(database) as opened:
        known = {prior.corr_data_id.id: prior.position[:2] for prior in opened.read_all_pose_priors()}
        places = [known.get(opened.read_image_with_name(name).image_id, np.zeros(2)) for name in names]
    return np.array([place if place.any() else (np.nan, np.nan) for place in places])  # a device without a fix: 0, 0


def match_features(
    database: Path, names: list[str], pairs: Pairs, folder: Path, advance: Advance, ratio: float = RATIO
) -> int:
    """Match pairs of photographs, and return the number of verified matches."""
    pycolmap = colmap()
    matching = pycolmap.FeatureMatchingOptions()
    matching.sift.max_ratio = ratio
    listed = folder / "pairs.txt"
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    for first in range(0, len(pairs), PAIRS_AT_ONCE):
        part = pairs[first : first + PAIRS_AT_ONCE]
        listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in part), encoding="utf-8")
        pycolmap.match_image_pairs(
            database, matching, pairing, verification_options=verification, device=pycolmap.Device.cpu
        )
        advance(len(part))
    with pycolmap.Database.open(database) as opened:
        return opened.num_inlier_matches()


def find_cameras(
    database: Path, photos: Path, folder: Path, names: list[str], enough: float, advance: Advance, say: Say
) -> tuple[int, str]:
    """Find cameras and points, and write the largest model to `folder`; the number of separate models (0: nothing is
    written) and the mapping. A second try is announced.

    If few photographs are not all placed, all pairs are matched, with doubtful matches, too. Incremental mapping begins
    with two photographs from well separated places that share much, which a walk straight ahead lacks. If it places
    fewer than `enough` photographs, global mapping, which solves for all positions at once, is tried, too; of few
    photographs, which it mostly places wrongly, only if there is no other model. The first model with most photographs
    wins, without those whose matches contradict it.
    """
    shutil.rmtree(folder, ignore_errors=True)

    def trusted(models: list[Any]) -> list[Any]:
        return [model for model in models if _leave_out_contradicted(model, database)]

    models, mapping = trusted(_map_incrementally(database, photos, folder, advance)), "incremental"
    if (placed := _size(models)[0]) < len(names) <= FEW:
        say(f"{placed} of {len(names)} photographs are placed. Trying again with more matches, for minutes.")
        with tempfile.TemporaryDirectory(dir=folder.parent) as place:
            more = _match_more(database, names, Path(place))
            others = trusted(_map_incrementally(more, photos, folder, lambda _: None))
        if _size(others)[0] > placed:
            models, mapping = others, "doubtful matches"
    if _size(models)[0] < enough and (len(names) > FEW or not models):
        others = trusted(_map_globally(database, photos, folder))
        if _size(others)[0] > _size(models)[0]:
            models, mapping = others, "global"
    if models:
        folder.mkdir(parents=True)
        max(models, key=lambda model: _size([model])).write(folder)
    return len(models), mapping


def _match_more(database: Path, names: list[str], place: Path) -> Path:
    """A copy of the database in which all pairs are matched, with doubtful matches, too."""
    copy = Path(shutil.copy(database, place))
    with colmap().Database.open(copy) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
    pairs = list(itertools.combinations(range(len(names)), 2))
    match_features(copy, names, pairs, place, lambda _: None, DOUBTFUL)
    return copy


def _size(models: list[Any]) -> tuple[int, int]:
    """Photographs and points of the largest model."""
    return max(((model.num_reg_images(), model.num_points3D()) for model in models), default=(0, 0))


def _map_incrementally(database: Path, photos: Path, folder: Path, advance: Advance) -> list[Any]:
    pycolmap = colmap()
    with pycolmap.Database.open(database) as opened:
        threads = 1 if opened.num_images() <= FEW else -1  # few: runs differ less, and take no longer
    options = pycolmap.IncrementalPipelineOptions(min_model_size=SMALLEST_MODEL, random_seed=SEED, num_threads=threads)
    with tempfile.TemporaryDirectory(dir=folder.parent) as attempts:
        models = pycolmap.incremental_mapping(
            database,
            photos,
            attempts,
            options=options,
            initial_image_pair_callback=lambda: advance(2),
            next_image_callback=lambda: advance(1),
        )
    return list(models.values())


def _map_globally(database: Path, photos: Path, folder: Path) -> list[Any]:
    """Global mapping, whose points, up to 15 pixels off, are triangulated again."""
    pycolmap = colmap()
    options = pycolmap.GlobalPipelineOptions(min_model_size=SMALLEST_MODEL, random_seed=SEED)
    with tempfile.TemporaryDirectory(dir=folder.parent) as attempts:
        models = list(pycolmap.global_mapping(database, photos, attempts, options=options).values())
        for model in models:
            pycolmap.triangulate_points(model, database, photos, attempts)
            pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    return [model for model in models if model.num_points3D() >= FEWEST_POINTS * model.num_reg_images()]


def _leave_out_contradicted(model: Any, database: Path) -> bool:
    """Leave out photographs whose cameras explain less than EXPLAINED of their matches, the worst one first, until none
    is left; whether more than half, and enough, remain."""
    pairs = _explained_matches(model, database)
    placed = model.num_reg_images()
    while pairs:
        every, explained = Counter(), Counter()
        for pair, (matches, close) in pairs.items():
            every.update(dict.fromkeys(pair, matches))
            explained.update(dict.fromkeys(pair, close))
        worst = min(every, key=lambda number: explained[number] / every[number])
        if explained[worst] >= EXPLAINED * every[worst]:
            break
        model.deregister_frame(model.images[worst].frame_id)
        pairs = {pair: counts for pair, counts in pairs.items() if worst not in pair}
    return model.num_reg_images() > max(placed / 2, SMALLEST_MODEL - 1)


def _explained_matches(model: Any, database: Path) -> dict[tuple[int, int], tuple[int, int]]:
    """Verified matches of each pair of placed photographs that has some, and how many the cameras explain: Sampson's
    distance is within the tolerance of the verification."""
    pycolmap = colmap()
    tolerance = pycolmap.TwoViewGeometryOptions().ransac.max_error  # pixels
    images = {number: model.images[number] for number in model.reg_image_ids()}
    rays, pairs = {}, {}
    with pycolmap.Database.open(database) as opened:
        for number, image in images.items():
            keypoints = np.asarray(opened.read_keypoints(number), dtype=np.float64)[:, :2]
            rays[number] = image.camera.cam_from_img(keypoints)
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = numbers = pycolmap.pair_id_to_image_pair(pair)
            matches = np.asarray(geometry.inlier_matches).reshape(-1, 2)
            if first not in images or second not in images or len(matches) == 0:
                continue
            a, b = images[first], images[second]
            essential = pycolmap.essential_matrix_from_pose(b.cam_from_world() * a.cam_from_world().inverse())
            x, y = rays[first][matches[:, 0]], rays[second][matches[:, 1]]
            focal = (a.camera.mean_focal_length() + b.camera.mean_focal_length()) / 2
            squares = np.array(pycolmap.compute_squared_sampson_error(x, y, essential))
            pairs[tuple(numbers)] = len(matches), int((squares <= (tolerance / focal) ** 2).sum())
    return pairs
