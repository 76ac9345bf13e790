# SPDX-License-Identifier: Apache-2.0
"""Which pairs are worth matching, and how long the rest will take."""

import numpy as np
import pytest
from PIL import ExifTags, Image

from nrfgs_ns.data.pictures import read_position
from nrfgs_ns.prepare import pairs


def descriptors(rng: np.random.Generator, number: int) -> np.ndarray:
    """Few of their 128 numbers are large, as in SIFT, so that no two look the same by chance."""
    return (rng.integers(64, 256, (number, 128)) * (rng.random((number, 128)) < 0.15)).astype(np.uint8)


def ring(count: int, shared: int = 40, own: int = 60) -> list[np.ndarray]:
    """Descriptors of photographs around a thing: each shares `shared` features with the next."""
    rng = np.random.default_rng(0)
    between = [descriptors(rng, shared) for _ in range(count)]
    return [np.concatenate([between[i], between[i - 1], descriptors(rng, own)]) for i in range(count)]


def test_shared_features_are_counted():
    done = []
    shared = pairs.shared_features([*ring(6), np.zeros((0, 128), np.uint8)], done.append)
    neighbours = np.roll(np.eye(6, dtype=int), 1, axis=1)
    assert (shared[:6, :6] == 40 * (neighbours + neighbours.T)).all() and sum(done) == 7
    assert (shared[6] == 0).all() and (shared[:, 6] == 0).all(), "a photograph without features"


def test_many_photographs_are_compared_in_parts():
    count = 2 * pairs.AT_ONCE + 3
    neighbours = np.roll(np.eye(count, dtype=int), 1, axis=1)
    shared = pairs.shared_features(ring(count, shared=20, own=5), lambda _: None)
    assert (shared == 20 * (neighbours + neighbours.T)).all()


def test_alike_near_and_following_photographs_are_paired():
    count = 40
    nothing = np.zeros((count, count), dtype=int)
    assert pairs.likely_pairs(nothing, None, in_a_row=False) == []

    alike = nothing.copy()
    alike[3, 30] = alike[30, 3] = 7
    assert pairs.likely_pairs(alike, None, in_a_row=False) == [(3, 30)]

    places = np.stack([100.0 * (np.arange(count) % 20), np.zeros(count)], axis=1)  # 20 places, each visited twice
    places[5] = np.nan
    near = pairs.likely_pairs(nothing, places, in_a_row=False)
    assert {(0, 20), (7, 27), (19, 39)} <= set(near) and (0, 19) not in near
    assert not any(5 in pair for pair in near), "where that one was taken is not known"

    following = pairs.likely_pairs(nothing, None, in_a_row=True)
    assert following == [(i, j) for i in range(count) for j in range(i + 1, min(i + 6, count))]
    every = pairs.likely_pairs(np.ones((8, 8), int), None, in_a_row=True)
    assert every == pairs.every_pair(8), "of few photographs, every pair"


def test_pairs_grow_with_the_photographs_not_with_their_square():
    rng = np.random.default_rng(0)
    alike = rng.integers(0, 50, (400, 400))
    chosen = pairs.likely_pairs(alike + alike.T, rng.random((400, 2)), in_a_row=True)
    assert len(set(chosen)) == len(chosen) <= 400 * (pairs.ALIKE + pairs.NEAREST + pairs.FOLLOWING)


def test_names_that_are_numbered_in_a_row():
    numbered = [f"IMG_{i:04d}.jpg" for i in range(300)]
    assert pairs.numbered_in_a_row(numbered)
    assert pairs.numbered_in_a_row(numbered[::2]), "every other one was thrown away"
    assert not pairs.numbered_in_a_row(numbered[::4])
    assert not pairs.numbered_in_a_row([f"IMG_{i * i:06d}.jpg" for i in range(300)])
    assert not pairs.numbered_in_a_row(["a.jpg", "b.jpg", "c.jpg"])


def placed(path, latitude=(55.0, 41.0, 53.4), longitude=(13.0, 11.0, 43.4), sides="NE"):
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: sides[0], 2: latitude, 3: sides[1], 4: longitude})
    Image.new("RGB", (8, 6)).save(path, exif=exif.tobytes())
    return path


def test_positions_are_read_and_laid_out_in_metres(tmp_path):
    place = 55 + 41 / 60 + 53.4 / 3600, 13 + 11 / 60 + 43.4 / 3600
    assert read_position(placed(tmp_path / "a.jpg")) == pytest.approx(place, abs=1e-6)
    southwest = read_position(placed(tmp_path / "b.jpg", sides="SW"))
    assert southwest == pytest.approx((-place[0], -place[1]), abs=1e-6)
    assert read_position(placed(tmp_path / "c.jpg", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))) is None
    assert read_position(placed(tmp_path / "d.jpg", latitude=(91.0, 0.0, 0.0))) is None
    Image.new("RGB", (8, 6)).save(tmp_path / "e.jpg")
    assert read_position(tmp_path / "e.jpg") is None

    laid = pairs.metres([(60.0, 10.0), None, (60.001, 10.0), (60.0, 10.002)])
    assert np.isnan(laid[1]).all()
    # A degree is 111.2 km, and half of it to the east at 60 degrees north.
    assert np.linalg.norm(laid[0] - laid[2]) == pytest.approx(111.2, abs=0.1)
    assert np.linalg.norm(laid[0] - laid[3]) == pytest.approx(111.2, abs=0.1)
    assert pairs.metres([None, (60.0, 10.0)]) is None


def test_the_forecast_counts_pairs_and_pixels():
    sizes = [(2000, 1000)] * 4
    assert pairs.pixels_searched(sizes, 1000) == pytest.approx(4 * 0.5)
    assert pairs.pixels_searched(sizes, 4000) == pytest.approx(4 * 2.0)
    few = pairs.remaining_cost(sizes, [4000] * 4, [(0, 1)])
    assert pairs.remaining_cost(sizes, [4000] * 4, pairs.every_pair(4)) - few == pytest.approx(5 * 16e6 * pairs.MATCH)
    assert pairs.remaining_cost(sizes, [4000] * 4, []) < few
