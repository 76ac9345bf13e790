# SPDX-License-Identifier: Apache-2.0
"""What the gloss dial promises: no view dependence at 0, ever more above it; and reflectance that is possible."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_ns.scenes import FIRST_SOLID, GROUND, SKY, SceneConfig, build_scene, camera_rays, dome_cameras
from nrfgs_ns.scenes.shading import mean_fresnel
from nrfgs_ns.scenes.textures import Waves

SMALL = dict(views=12, width=40, height=30)


def surface_points(scene, count=600, seed=0):
    """Points [N, 3] that the cameras see, and their surfaces [N]. float64."""
    config = scene.config
    rng = np.random.default_rng(seed)
    cameras = dome_cameras(config)[rng.integers(config.views, size=count)]
    pixels = rng.uniform((0, 0), (config.width, config.height), size=(count, 2))
    origins, directions = (a.astype(np.float64) for a in camera_rays(config, cameras, pixels))
    return scene.first_hit(origins, directions)


def views_above(scene, points, surfaces, count, seed=1):
    """Directions [count, N, 3] uniform over the hemisphere that each surface point can be seen from."""
    normals = scene.world.normals(points.T, surfaces).T
    directions = np.random.default_rng(seed).normal(size=(count, len(points), 3))
    directions *= np.sign((directions * normals).sum(-1, keepdims=True))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def test_every_surface_is_seen():
    scene = build_scene(SceneConfig(**SMALL))
    _, surfaces = surface_points(scene, 4000)
    assert set(surfaces) == {SKY, GROUND, *range(FIRST_SOLID, FIRST_SOLID + len(scene.objects))}


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_without_gloss_every_point_has_one_colour(seed):
    scene = build_scene(SceneConfig(gloss=0.0, seed=seed % 1000, **SMALL))
    points, surfaces = surface_points(scene, 100, seed)
    views = views_above(scene, points, surfaces, 4, seed)
    first, *others = [scene.outgoing_radiance(points, surfaces, v) for v in views]
    for other in others:
        np.testing.assert_array_equal(other, first)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_without_gloss_rays_from_everywhere_bring_that_colour(dtype):
    scene = build_scene(SceneConfig(gloss=0.0, **SMALL))
    points, surfaces = surface_points(scene)
    expected = scene.outgoing_radiance(points, surfaces, views_above(scene, points, surfaces, 1)[0])
    compared = 0
    for view in views_above(scene, points, surfaces, 5, seed=2):
        origins = (points + 0.05 * view).astype(dtype)
        hits, again = scene.first_hit(origins, -view.astype(dtype))
        # Rays that meet another object within 0.05, start in one, or just miss the edge, see something else; grazing
        # ones (n.v < 0.1) magnify rounding.
        facing = (scene.world.normals(points.T, surfaces).T * view).sum(-1)
        same = (again == surfaces) & (np.linalg.norm(hits - points, axis=1) < 1e-3) & (facing > 0.1)
        assert same.mean() > 0.75
        compared += same.sum()
        arriving = scene.radiance(origins, -view.astype(dtype))
        assert arriving.dtype == dtype
        # Rounding moves the hit by a few eps x 10 (the dome's radius) / 0.1 (grazing), and colours change by at most
        # some 20 per unit length (the steepest texture edge: tanh slope 3 x pi x 4 fields / radius 0.3 / 2, times 0.3).
        np.testing.assert_allclose(arriving[same], expected[same], atol=4 * np.finfo(dtype).eps * 10 / 0.1 * 20)
    assert compared > 2000


def view_variance(gloss):
    """Mean over points and channels of the variance over views of the radiance."""
    scene = build_scene(SceneConfig(gloss=gloss, **SMALL))
    points, surfaces = surface_points(scene, 800)
    radiance = [scene.outgoing_radiance(points, surfaces, v) for v in views_above(scene, points, surfaces, 12)]
    return np.var(radiance, axis=0).mean()


def test_view_dependence_grows_with_gloss():
    variances = [view_variance(gloss) for gloss in np.linspace(0.0, 1.0, 6)]
    assert variances[0] < 1e-30  # the mean of equal numbers may differ from them by rounding: (1e-16)^2
    assert (np.diff(variances) > 0.0).all()
    assert variances[1] > 1e-5


def test_sky_and_floor_are_never_glossy():
    scene = build_scene(SceneConfig(gloss=1.0, **SMALL))
    points, surfaces = surface_points(scene)
    matt = surfaces < FIRST_SOLID
    a, b = (scene.outgoing_radiance(points, surfaces, v) for v in views_above(scene, points, surfaces, 2))
    np.testing.assert_array_equal(a[matt], b[matt])
    assert (np.abs(a[~matt] - b[~matt]).max(axis=1) > 1e-6).mean() > 0.95


def test_radiance_is_outgoing_radiance_of_the_first_hit():
    scene = build_scene(SceneConfig(gloss=0.7, **SMALL))
    origins, directions = (a.astype(np.float64) for a in _image_rays(scene.config))
    points, surfaces = scene.first_hit(origins, directions)
    np.testing.assert_allclose(
        scene.radiance(origins, 3.0 * directions), scene.outgoing_radiance(points, surfaces, -directions), rtol=1e-9
    )


def test_single_precision_is_enough():
    scene = build_scene(SceneConfig(**SMALL))
    origins, directions = _image_rays(scene.config)
    single = scene.radiance(origins, directions)
    double = scene.radiance(origins.astype(np.float64), directions.astype(np.float64))
    assert single.dtype == np.float32 and np.isfinite(single).all() and (single >= 0.0).all()
    # A ray at an object's edge may hit in one precision and miss in the other; all others agree far below 1/255.
    assert (np.abs(single - double).max(axis=1) < 5e-4).mean() > 0.995


def test_no_surface_reflects_more_than_arrives():
    scene = build_scene(SceneConfig())
    rng = np.random.default_rng(0)
    local = rng.uniform(-1.0, 1.0, size=(3, 20_000))
    assert 0.0 <= scene.floor(10 * local, scene.noises[GROUND]).min()
    assert scene.floor(10 * local, scene.noises[GROUND]).max() <= 1.0
    for item, noise in zip(scene.objects, scene.noises[FIRST_SOLID:], strict=True):
        specular = mean_fresnel(max(item.finish.f0))
        diffuse = (1.0 - specular) * item.paint(local, noise)
        assert diffuse.min() >= 0.0 and diffuse.max() + specular <= 1.0


def test_noise_stays_within_one():
    noise = Waves.random(np.random.default_rng(3), (2.0, 5.0))
    values = noise(np.random.default_rng(4).uniform(-5, 5, size=(3, 10_000)))
    assert np.abs(values).max() <= 1.0 and values.std() > 0.1


def test_seed_changes_the_textures_and_nothing_else():
    a, b = (build_scene(SceneConfig(seed=seed, **SMALL)) for seed in (0, 1))
    origins, directions = _image_rays(a.config)
    assert a.describe() == b.describe()
    assert np.abs(a.radiance(origins, directions) - b.radiance(origins, directions)).mean() > 1e-3


def _image_rays(config):
    xs, ys = np.meshgrid(np.arange(config.width) + 0.5, np.arange(config.height) + 0.5)
    return camera_rays(config, dome_cameras(config)[5], np.stack([xs, ys], axis=-1).reshape(-1, 2))


def test_without_a_mirror_nothing_is_reflected():
    """What leaves a surface is then the same whether or not rays are followed off it, and it still shines."""
    for mirror in (0.0, 1.0):
        scene = build_scene(SceneConfig(mirror=mirror, **SMALL))
        points, surfaces = surface_points(scene)
        solid = surfaces >= FIRST_SOLID
        points, surfaces = points[solid], surfaces[solid]
        directions = views_above(scene, points, surfaces, 2)
        alone, followed = (scene._outgoing(points.T, surfaces, directions[0].T, bounces) for bounces in (0, 2))
        assert np.array_equal(alone, followed) == (mirror == 0.0)
        other = scene._outgoing(points.T, surfaces, directions[1].T, 0)
        assert np.abs(other - alone).mean() > 0.01
