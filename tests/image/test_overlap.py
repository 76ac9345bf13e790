# SPDX-License-Identifier: Apache-2.0
"""Photographs of known exposure of a painted wall, from places next to each other."""

import math

import pytest
import torch
from exposures import exposed

from nrfgs_ns.image import overlap
from nrfgs_ns.image.overlap import ENOUGH_KNOWN_STOPS, ENOUGH_STOPS, Pairs, compare, estimate, sight, slope, spread
from nrfgs_ns.image.photograph import BASIS

WIDTH, HEIGHT, FOCAL = 120, 90, 110.0
K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
UNKNOWN = math.nan


def wall(count: int = 3000, seed: int = 0):
    """Points on a wall at z = 0, [N, 3], whose colour varies slowly."""
    generator = torch.Generator().manual_seed(seed)
    return torch.cat([torch.rand(count, 2, generator=generator) * 4 - 2, torch.zeros(count, 1)], dim=1)


def photographs(stops, gloss: float = 0.0):
    """Views of the wall from 3 away, each a little to the right of the one before, with these stops [V, 3].
    With gloss, a light that is brightest to the right of the camera adds stops, other ones in each place."""
    viewmats, images = torch.eye(4).repeat(len(stops), 1, 1), []
    viewmats[:, :3, 3] = -places(len(stops))
    column, row = torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy")
    for own, offset in zip(stops, places(len(stops))[:, 0], strict=True):
        x, y = (column - WIDTH / 2) / FOCAL * 3 + offset, (row - HEIGHT / 2) / FOCAL * 3
        light = own + gloss * torch.sin(25 * (x - 3 * offset))[..., None]
        paint = 0.4 + 0.2 * torch.stack([torch.sin(2 * x), torch.cos(1.5 * y), torch.sin(x + y)], dim=-1)
        channels = zip(paint.split(1, dim=-1), light.split(1, dim=-1), strict=True)
        images.append(torch.cat([exposed(color, stop) for color, stop in channels], dim=-1))
    return viewmats, images


def looks_of(stops, gloss: float = 0.0):
    """Exposures estimated from photographs with these stops [V, 3]."""
    return estimate(pairs_of(stops, gloss), torch.full((len(stops),), UNKNOWN), places(len(stops)))


def error(looks, stops) -> float:
    """Largest error of a channel's exposure, in stops."""
    return (looks.stops @ torch.tensor(BASIS) - (stops - stops.mean(0))).abs().max()


def places(count: int):
    return torch.tensor([[0.05 * index, 0.0, -3.0] for index in range(count)])


def enough(looks) -> list[bool]:
    return [size >= least for size, least in zip(looks.random, ENOUGH_STOPS, strict=True)]


def pairs_of(stops, gloss: float = 0.0):
    cameras, images = photographs(stops, gloss)
    sightings = [sight(wall(), camera, K, image) for camera, image in zip(cameras, images, strict=True)]
    return compare(sightings, -cameras[:, :3, 3])


def test_same_exposure_is_found_to_be_the_same_and_gloss_is_noise():
    assert len(pairs_of(torch.zeros(8, 3)).first) >= 8
    looks = looks_of(torch.zeros(8, 3))
    assert not any(enough(looks)) and looks.stops.abs().max() < 0.02
    assert pairs_of(torch.zeros(8, 3), gloss=0.5).shift[:, 0].abs().max() > 0.02
    assert not any(enough(looks_of(torch.zeros(8, 3), gloss=0.5)))


def test_known_stops_are_found():
    torch.manual_seed(1)
    stops = torch.randn(12, 1) * 0.5 + torch.randn(12, 3) * 0.2
    looks = looks_of(stops)
    assert all(enough(looks)) and 0.25 < looks.random[0] < 0.9
    assert error(looks, stops) < 0.1


def test_white_balance_alone_is_noticed():
    stops = torch.zeros(12, 3)
    stops[torch.randperm(12, generator=torch.Generator().manual_seed(0))[:6], 0] = 0.5
    assert enough(looks_of(stops)) == [False, True, False]


def test_what_changes_slowly_from_place_to_place_is_the_scenes():
    slowly = torch.linspace(0.0, 1.2, 16)[:, None].expand(16, 3)
    looks = looks_of(slowly)
    assert not any(enough(looks)) and looks.stops.abs().max() < 0.1
    pattern = slowly[:, 0] - slowly[:, 0].mean()  # which is held
    assert (looks.held[0].T @ pattern).norm() > 0.99 * pattern.norm()
    for held in looks.held:  # orthonormal patterns, the constant among them
        torch.testing.assert_close(held.T @ held, torch.eye(held.shape[1]), atol=1e-5, rtol=0)
        torch.testing.assert_close(held @ held.sum(dim=0), torch.ones(16))
    shuffled = looks_of(slowly[torch.randperm(16, generator=torch.Generator().manual_seed(0))])
    assert enough(shuffled)[0] and shuffled.held[0].shape[1] < 8


def test_of_a_large_capture_a_part_says_how_photographs_differ(monkeypatch):
    monkeypatch.setattr(overlap, "MOST_PHOTOGRAPHS", 16)
    torch.manual_seed(3)
    stops = torch.randn(24, 1) * 0.4 + torch.zeros(24, 3)
    looks = looks_of(stops)
    assert enough(looks) == [True, False, False]
    assert error(looks, stops) < 0.2
    assert all(pattern.shape == (24, 1) for pattern in looks.held)
    assert not any(enough(looks_of(torch.zeros(24, 3))))


def test_thousands_of_photographs_need_no_dense_system(monkeypatch):
    sizes, solve = [0], torch.linalg.solve  # whose cost grows with the cube of the size
    monkeypatch.setattr(torch.linalg, "solve", lambda a, b: sizes.append(len(a)) or solve(a, b))
    torch.manual_seed(3)
    stops, first = torch.randn(5000, 3) * 0.3, torch.arange(10_000) % 5000
    second = (first + 1 + torch.arange(10_000) // 5000) % 5000
    pairs = Pairs(first, second, stops[second] - stops[first], torch.full((10_000, 3), 0.02))
    looks = estimate(pairs, torch.full((5000,), UNKNOWN), places(5000))
    assert max(sizes) <= overlap.MOST_PHOTOGRAPHS and (looks.stops - stops + stops.mean(dim=0)).abs().max() < 0.2


def test_hidden_points_and_dark_or_bright_pixels_are_left_out():
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -9.0]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    image = torch.full((HEIGHT, WIDTH, 3), 0.5)
    image[:, 90:] = 0.99
    seen = sight(points, viewmat, K, image)
    assert seen.points.tolist() == [1, 3]  # 0 is behind 1, 2 is too bright, 4 is behind the camera
    assert len(sight(points, viewmat, K, image, torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)).points) == 0


def test_exif_is_a_start_as_far_as_photographs_agree_with_it():
    torch.manual_seed(2)
    exposure = torch.tensor([0.0, 1.0, -0.5, 0.3, 0.8, -1.0, 0.2, -0.4])
    pairs = pairs_of(exposure[:, None].expand(8, 3))
    assert slope(pairs, exposure) == pytest.approx(1.0, abs=0.05)
    lies = exposure[torch.randperm(8)] * 5
    assert slope(pairs, lies) < 0.2
    assert (estimate(pairs, lies, places(8)).stops[:, 0] - (exposure - exposure.mean())).abs().max() < 0.2


def test_exif_alone():
    nothing, known = compare([], torch.zeros(0, 3)), torch.tensor([0.0, 1.0, UNKNOWN, 2.0])
    assert spread(known) >= ENOUGH_KNOWN_STOPS > spread(torch.tensor([0.3, 0.4, UNKNOWN]))
    assert spread(torch.tensor([UNKNOWN])) == 0.0
    assert slope(nothing, known) == 1.0
    looks = estimate(nothing, known, torch.rand(4, 3))
    assert looks.stops[:, 0].tolist() == pytest.approx([-1.0, 0.0, 0.0, 1.0])
    assert all(pattern.flatten().tolist() == pytest.approx([0.5] * 4) for pattern in looks.held)


def test_bytes_and_large_pictures_are_the_same_as_small_ones_in_floats():
    cameras, images = photographs(torch.zeros(1, 3))
    large = images[0].repeat_interleave(8, dim=0).repeat_interleave(8, dim=1)
    one = sight(wall(), cameras[0], K, images[0])
    other = sight(wall(), cameras[0], K * torch.tensor([[8.0], [8.0], [1.0]]), (large * 255).round().to(torch.uint8))
    common = torch.isin(one.points, other.points)
    assert common.sum() > 1000
    assert (one.light[common] - other.light[torch.isin(other.points, one.points)]).abs().median() < 0.02
