# SPDX-License-Identifier: Apache-2.0
"""Which pairs are worth matching."""

import itertools

import numpy as np
import pytest
from PIL import ExifTags, Image

from nrfgs_prepare import pairs, structure

pytest.importorskip("pycolmap")


def descriptors(rng: np.random.Generator, number: int) -> np.ndarray:
    """Few of their 128 numbers are large, as in SIFT, so that no two look the same by chance."""
    return (rng.integers(64, 256, (number, 128)) * (rng.random((number, 128)) < 0.15)).astype(np.uint8)


@pytest.mark.parametrize("count", [6, 2 * pairs.AT_ONCE + 3])
def test_shared_features_are_counted(count):
    """Around a thing, where each photograph shares 20 features with the next."""
    rng, done = np.random.default_rng(0), []
    between = [descriptors(rng, 20) for _ in range(count)]
    ring = [np.concatenate([between[i], between[i - 1], descriptors(rng, 5)]) for i in range(count)]
    shared = pairs.shared_features([*ring, np.zeros((0, 128), np.uint8)], done.append)
    neighbours = np.roll(np.eye(count, dtype=int), 1, axis=1)
    assert (shared[:-1, :-1] == 20 * (neighbours + neighbours.T)).all() and sum(done) == count + 1
    assert (shared[-1] == 0).all() and (shared[:, -1] == 0).all(), "a photograph without features"


def test_alike_near_and_following_photographs_are_paired():
    count = 40
    nothing, nowhere = np.zeros((count, count), dtype=int), np.full((count, 3), np.nan)
    assert pairs.likely_pairs(nothing, nowhere, in_a_row=False) == []

    alike = nothing.copy()
    alike[3, 30] = alike[30, 3] = 7
    assert pairs.likely_pairs(alike, nowhere, in_a_row=False) == [(3, 30)]

    places = np.stack([100.0 * (np.arange(count) % 20), np.zeros(count)], axis=1)  # 20 places, each visited twice
    places[5] = np.nan
    near = pairs.likely_pairs(nothing, places, in_a_row=False)
    assert {(0, 20), (7, 27), (19, 39)} <= set(near) and (0, 19) not in near
    assert not any(5 in pair for pair in near), "where that one was taken is not known"

    following = pairs.likely_pairs(nothing, nowhere, in_a_row=True)
    assert following == [(i, j) for i in range(count) for j in range(i + 1, min(i + 6, count))]
    every = pairs.likely_pairs(np.ones((8, 8), int), nowhere[:8], in_a_row=True)
    assert every == list(itertools.combinations(range(8), 2)), "of few photographs, every pair"


def test_names_that_are_numbered_in_a_row():
    numbered = [f"IMG_{i:04d}.jpg" for i in range(300)]
    assert pairs.numbered_in_a_row(numbered)
    assert pairs.numbered_in_a_row(numbered[::2]), "every other one was thrown away"
    assert not pairs.numbered_in_a_row(numbered[::4])
    assert not pairs.numbered_in_a_row([f"IMG_{i * i:06d}.jpg" for i in range(300)])
    assert not pairs.numbered_in_a_row(["a.jpg", "b.jpg", "c.jpg"])


def test_positions_are_laid_out_in_metres(tmp_path):
    """From COLMAP's database, which has EXIF's positions of photographs with an altitude."""
    degrees, seconds = (55.0, 41.0, 53.4), (13.0, 11.0, 43.4)
    tags = {
        "north.jpg": {1: "N", 2: degrees, 3: "E", 4: seconds, 6: 10.0},
        "south.jpg": {1: "S", 2: degrees, 3: "W", 4: seconds, 6: 10.0},
        "without a fix.jpg": {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0), 6: 10.0},
        "none.jpg": {},
    }
    for name, values in tags.items():
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(values)
        Image.effect_noise((160, 120), 64).convert("RGB").save(tmp_path / name, exif=exif.tobytes())
    database = tmp_path / "database.db"
    structure.extract_features(database, tmp_path, [list(tags)], lambda _: None, "SIMPLE_RADIAL", 100)
    place = np.array([55 + 41 / 60 + 53.4 / 3600, 13 + 11 / 60 + 43.4 / 3600])
    np.testing.assert_allclose(structure.positions(database, list(tags)), [place, -place, [np.nan] * 2, [np.nan] * 2])

    laid = pairs.metres(np.array([(60.0, 10.0), (np.nan, np.nan), (60.001, 10.0), (60.0, 10.002)]))
    assert np.isnan(laid[1]).all()
    # A degree is 111.2 km, and half of it to the east at 60 degrees north.
    assert np.linalg.norm(laid[0] - laid[2]) == pytest.approx(111.2, abs=0.1)
    assert np.linalg.norm(laid[0] - laid[3]) == pytest.approx(111.2, abs=0.1)
