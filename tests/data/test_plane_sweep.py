# SPDX-License-Identifier: Apache-2.0
"""The plane sweep, on views of a textured plane, computed exactly."""

import math
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from nrfgs_ns.data import plane_sweep as sweep
from nrfgs_ns.model.initial_splats import start_with_dense_points

SIZE, FOCAL, DISTANCE = 48, 60.0, 4.0


def texture(x, y):
    """A pattern without repetition, in 0..1."""
    waves = [(3.1, 1.7), (-2.3, 4.9), (5.3, -3.7), (7.9, 6.1), (0.9, -8.3)]
    grey = sum(torch.sin(a * x + b * y + a * b) for a, b in waves) / 10 + 0.5
    return torch.stack([grey, 0.8 * grey + 0.1, 0.6 * grey + 0.2], dim=-1)


def plane(centers, unit=1.0, brightness=(1.0,), pattern=texture):
    """Views from `centers` [V, 2], looking along z at the slanted plane z = 4 + x / 4, and points of it."""
    eye = torch.zeros(len(centers), 3)
    eye[:, :2] = torch.tensor(centers)
    pixels = torch.arange(SIZE) + 0.5 - SIZE / 2
    y, x = torch.meshgrid(pixels / FOCAL, pixels / FOCAL, indexing="ij")
    rgb = []
    for index, center in enumerate(eye):
        depth = (DISTANCE + center[0] / 4) / (1 - x / 4)
        rgb.append(brightness[index % len(brightness)] * pattern(center[0] + depth * x, center[1] + depth * y))
    poses = torch.eye(4).repeat(len(eye), 1, 1)
    poses[:, :3, 3] = -eye * unit
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).repeat(len(eye), 1, 1)
    flat = torch.rand(200, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    points = torch.cat([flat, DISTANCE + flat[:, :1] / 4], dim=1)
    return sweep.small_views(rgb, [None] * len(rgb), K, poses), points * unit


AROUND = [(0.5 * math.cos(a), 0.5 * math.sin(a)) for a in (0, 1.2, 2.5, 3.7, 5.0)]


@pytest.mark.parametrize("unit", [1.0, 1000.0, 1e-3])
def test_points_lie_on_what_the_views_show_in_any_unit(unit):
    xyz, rgb = sweep.dense_points(*plane(AROUND, unit), share=1.0)
    xyz = xyz / unit
    off = (xyz[:, 2] - DISTANCE - xyz[:, 0] / 4).abs() / DISTANCE
    assert len(xyz) > 1000
    assert off.median() < 0.003 and off.max() < 0.05
    torch.testing.assert_close(rgb[off < 0.003], texture(xyz[:, 0], xyz[:, 1])[off < 0.003], atol=0.1, rtol=0)


def test_exposure_does_not_matter_and_nothing_is_found_where_nothing_can_be_told():
    even, _ = sweep.dense_points(*plane(AROUND), share=1.0)
    uneven, _ = sweep.dense_points(*plane(AROUND, brightness=(1.0, 0.7, 0.9)), share=1.0)
    assert len(uneven) == pytest.approx(len(even), rel=0.05)
    plain = plane(AROUND, pattern=lambda x, y: 0.5 + 0 * torch.stack([x, y, x], dim=-1))
    masked, points = plane(AROUND)
    masked = masked._replace(valid=torch.zeros_like(masked.valid))
    for views, own in (plane([(0.0, 0.0)] * 4), plain, (masked, points), plane(AROUND[:2])):
        xyz, rgb = sweep.dense_points(views, own, share=1.0)
        assert xyz.shape == rgb.shape == (0, 3)


def test_masks_and_transparency_are_no_places_for_points():
    image = torch.full((SIZE, 2 * SIZE, 4), 255, dtype=torch.uint8)
    image[:10, :, 3] = 0
    mask = torch.ones(SIZE, 2 * SIZE, 1, dtype=torch.bool)
    mask[:, :20] = False
    upright = torch.full((300, 100, 3), 128, dtype=torch.uint8)
    K = torch.eye(3).repeat(2, 1, 1)
    views = sweep.small_views([image, upright], [mask, None], K, torch.eye(4).repeat(2, 1, 1))
    assert isinstance(views, sweep.Views) and views.rgb.shape == (2, 256, 96, 3)
    assert not views.valid[0, :10].any() and not views.valid[0, :, :20].any() and views.valid[0, 10:48, 20:].all()
    assert not views.valid[0, 48:].any() and not views.valid[1, :, 85:].any() and views.valid[1, :, :85].all()
    torch.testing.assert_close(views.intrinsics[1].diagonal(), torch.tensor([0.85, 256 / 300, 1.0]))


def test_the_share_falls_smoothly_to_nothing():
    shares = [sweep.share_kept(views) / sweep.KEPT for views in range(3, 400)]
    assert shares[0] == pytest.approx(1.0, rel=0.01) and shares[-1] == 0
    assert all(0 <= a - b < 0.02 + 0.05 * (b == 0) for a, b in zip(shares, shares[1:], strict=False))
    few, again, every = (sweep.dense_points(*plane(AROUND), share=share)[0] for share in (0.25, 0.25, 1.0))
    assert len(few) == pytest.approx(len(every) / 4, rel=0.2) and torch.equal(few, again)


def test_a_training_starts_with_them_if_asked_to():
    views, own = plane(AROUND)
    poses = torch.linalg.inv(views.world_to_camera)[:, :3] * torch.tensor([1.0, -1.0, -1.0, 1.0])
    images = [{"image": (255 * image).round().to(torch.uint8)} for image in views.rgb]
    dataset = SimpleNamespace(cameras=Cameras(poses, FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE))
    started = []
    model = SimpleNamespace(
        config=SimpleNamespace(dense_start="auto", random_init=False),
        seed_points=(own, torch.full_like(own, 9.0)),
        num_views=len(AROUND),
        device=torch.device("cpu"),
        start_from=started.append,
    )
    datamanager = SimpleNamespace(train_dataset=dataset, cached_train=images)
    start_with_dense_points(model, datamanager)
    (xyz, rgb), count = started[0], len(own)
    assert torch.equal(xyz[:count], own) and (rgb[:count] == 9).all() and len(xyz) > count + 200
    assert ((xyz[:, 2] - DISTANCE - xyz[:, 0] / 4).abs().median() / DISTANCE) < 0.003 and 20 < rgb[count:].mean() < 235
    for config in ({"dense_start": "off", "random_init": False}, {"dense_start": "auto", "random_init": True}):
        model.config = SimpleNamespace(**config)
        start_with_dense_points(model, datamanager)
        assert len(started) == 1
