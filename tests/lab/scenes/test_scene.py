# SPDX-License-Identifier: Apache-2.0
"""Procedural scenes: geometry, shading, and all together."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_lab.scenes import SceneConfig, build_scene, camera_rays, dome_cameras
from nrfgs_lab.scenes.geometry import CAMERA, FIRST_SOLID, GROUND, SKY, Box, Sphere, World
from nrfgs_lab.scenes.shading import (
    Ambient,
    Finish,
    fresnel,
    ggx_lobe,
    highlight,
    mean_fresnel,
    tone_curve,
)

SPHERE = Sphere((0.3, -0.2, 0.7), 0.7)
BOX = Box((-0.9, 0.8, 0.5), (0.3, 0.4, 0.5), yaw=0.6)
WORLD = World(sky_radius=10.0, solids=(SPHERE, BOX))


def signed_distance_sphere(p):
    return np.linalg.norm(p - np.array(SPHERE.middle), axis=-1) - SPHERE.radius


def signed_distance_box(p):
    """Textbook distance to a box, with the turn written as a rotation matrix."""
    c, s = np.cos(BOX.yaw), np.sin(BOX.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    q = np.abs((p - np.array(BOX.middle)) @ rotation) - np.array(BOX.half_sides)
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)


SOLIDS = [pytest.param(SPHERE, signed_distance_sphere, id="sphere"), pytest.param(BOX, signed_distance_box, id="box")]


def random_rays(count, seed=0):
    """Rays from a shell about the scene towards its middle, so that about half of them hit something. [N, 3] each."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins = 4.0 * origins / np.linalg.norm(origins, axis=1, keepdims=True)
    origins[:, 2] = np.abs(origins[:, 2]) + 0.01
    directions = rng.uniform(-1.0, 1.0, size=(count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize(("solid", "signed_distance"), SOLIDS)
def test_interval_is_where_the_line_is_inside(solid, signed_distance):
    origins, directions = random_rays(400)
    enter, leave = solid.interval(origins.T, directions.T)
    hit = enter < leave
    assert 40 < hit.sum() < 360

    for t in (enter, leave):
        on_surface = origins[hit] + t[hit, None] * directions[hit]
        # A few operations on numbers below 10 in float64: 1e-15 each. Near-tangent rays lose half the digits along the
        # ray, but not in their distance to the surface.
        np.testing.assert_allclose(signed_distance(on_surface), 0.0, atol=1e-12)

    ts = np.linspace(0.0, 8.0, 801)
    inside = signed_distance(origins[:, None] + ts[:, None] * directions[:, None]) < -1e-9
    between = (ts > enter[:, None]) & (ts < leave[:, None])
    np.testing.assert_array_equal(inside, between)


@pytest.mark.parametrize(("solid", "signed_distance"), SOLIDS)
def test_normals_are_unit_and_the_gradient_of_distance(solid, signed_distance):
    origins, directions = random_rays(400)
    enter, leave = solid.interval(origins.T, directions.T)
    hit = enter < leave
    points = origins[hit] + enter[hit, None] * directions[hit]
    normals = solid.normals(points.T).T
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    step = 1e-5
    gradient = np.stack(
        [(signed_distance(points + step * e) - signed_distance(points - step * e)) / (2 * step) for e in np.eye(3)], 1
    )
    # Central differences: error of order step^2 = 1e-10 from curvature and 1e-16 / step = 1e-11 from rounding. No ray
    # of this seed comes within a step of a box edge, where the distance has a kink.
    np.testing.assert_allclose(normals, gradient, atol=1e-8)


def test_first_hit_is_the_nearest_surface_and_the_world_is_closed():
    origins, directions = random_rays(500, seed=1)
    outside = (signed_distance_sphere(origins) > 0) & (signed_distance_box(origins) > 0)
    origins, directions = origins[outside], directions[outside]
    distance, surface = WORLD.first_hit(origins.T, directions.T, np.full(len(origins), CAMERA))
    assert np.isfinite(distance).all() and (distance > 0).all()
    assert set(surface) == {SKY, GROUND, FIRST_SOLID, FIRST_SOLID + 1}

    def clearance(p):  # distance to the nearest thing, from inside the free space
        others = [signed_distance_sphere(p), signed_distance_box(p), p[..., 2], 10.0 - np.linalg.norm(p, axis=-1)]
        return np.min(others, axis=0)

    np.testing.assert_allclose(clearance(origins + distance[:, None] * directions), 0.0, atol=1e-12)
    # Sphere tracing - steps as long as the clearance - cannot step past a surface, so both must stop at the same one.
    t = np.zeros(len(origins))
    for _ in range(3000):
        t += clearance(origins + t[:, None] * directions)
    np.testing.assert_allclose(t, distance, atol=1e-6)


def test_surface_that_is_left_is_skipped():
    points = np.array([[0.3, -0.2, 1.4]]).T  # the top of the sphere
    down = np.array([[0.0, 0.0, -1.0]]).T
    _, surface = WORLD.first_hit(points, down, np.array([FIRST_SOLID]))
    assert surface[0] == GROUND
    _, surface = WORLD.first_hit(np.array([[3.0, 0.0, 0.0]]).T, down, np.array([GROUND]))
    assert surface[0] == SKY


def test_shadow_is_full_through_the_middle_none_in_the_open_and_soft_between():
    lamp = np.array([0.3, -0.2, 5.0])
    points = np.array([[0.3, -0.2, 0.0], [4.0, 4.0, 0.0]] + [[0.3 + x, -0.2, 0.0] for x in np.linspace(0.0, 1.2, 50)])
    towards = lamp - points
    distance = np.linalg.norm(towards, axis=1)

    def share(distances, surface=GROUND):
        rays = points.T, (towards / distance[:, None]).T
        return WORLD.shadow(*rays, distances, np.full(len(points), surface), softness=0.35)

    blocked, open_, *rim = share(distance)
    assert blocked == rim[0] == 0.0 and open_ == rim[-1] == 1.0
    assert (np.diff(rim) >= 0.0).all() and ((np.array(rim) > 0.05) & (np.array(rim) < 0.95)).any()
    # The sphere does not shade itself, nor does what lies behind the lamp: it touches the ground at the first point.
    assert share(distance, surface=FIRST_SOLID)[0] == 1.0
    assert share(np.full(len(points), 1e-3))[0] > 1.0 - 3e-5


def test_openness_is_the_unblocked_share_of_cosine_weighted_directions():
    ball = Sphere((0.8, 0.3, 1.6), 0.6)  # wholly above the horizon of the points, where the formula is exact
    world = World(sky_radius=10.0, solids=(ball,))
    point = np.array([[0.1, 0.0, 0.0]]).T
    up = np.array([[0.0, 0.0, 1.0]]).T
    rng = np.random.default_rng(0)
    count = 200_000
    height, azimuth = np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)  # density cos / pi
    across = np.sqrt(1.0 - height**2)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height])
    enter, leave = ball.interval(np.broadcast_to(point, directions.shape), directions)
    blocked = (enter < leave).mean()
    assert 0.05 < blocked < 0.3
    # Standard error sqrt(p (1 - p) / n) < 0.5 / sqrt(2e5) = 1.1e-3; five of them.
    assert world.openness(point, up, np.array([GROUND]))[0] == pytest.approx(1.0 - blocked, abs=5.6e-3)


def hemisphere(polar_steps=2000, azimuth_steps=64):
    """Midpoint rule over the upper hemisphere: directions [3, N] and solid angles [N] that sum to 2 pi."""
    # Midpoints in u with cos = 1 - u^2 crowd towards the pole, where narrow lobes live; |d cos / d u| = 2 u.
    u = (np.arange(polar_steps) + 0.5) / polar_steps
    azimuth = 2 * np.pi * (np.arange(azimuth_steps) + 0.5) / azimuth_steps
    u, azimuth = (a.ravel() for a in np.meshgrid(u, azimuth, indexing="ij"))
    height = 1.0 - u * u
    across = np.sqrt(1.0 - height**2)
    weight = 2.0 * u * (2 * np.pi) / (polar_steps * azimuth_steps)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height]), weight


def test_mean_fresnel_is_the_cosine_weighted_mean():
    directions, weight = hemisphere()
    f0 = np.array([[0.04], [0.5], [1.0]])
    mean = (fresnel(f0, directions[2]) * directions[2] * weight).sum(axis=1) / np.pi
    # The midpoint rule with 2000 steps errs by about (1 / 2000)^2 times second derivatives of order 10.
    np.testing.assert_allclose([mean_fresnel(value) for value in f0[:, 0]], mean, atol=1e-5)


@pytest.mark.parametrize("tilt", [0.0, 0.7, 1.5, 3.0])
def test_ambient_irradiance_is_the_integral_of_its_radiance(tilt):
    ambient = Ambient(below=(0.1, 0.4, 0.2), above=(0.5, 0.3, 0.2))
    directions, weight = hemisphere(400, 256)
    # Turn the hemisphere about the y axis, so that its pole is the normal.
    c, s = np.cos(tilt), np.sin(tilt)
    height = -s * directions[0] + c * directions[2]
    below, above = np.array(ambient.below)[:, None], np.array(ambient.above)[:, None]
    radiance = 0.5 * (below + above) + 0.5 * (above - below) * height
    integral = (radiance * directions[2] * weight).sum(axis=1)
    normal = np.array([[s], [0.0], [c]])
    np.testing.assert_allclose(ambient.irradiance(normal)[:, 0], integral, rtol=1e-4)  # midpoint rule, (1 / 400)^2 x 10


@pytest.mark.parametrize("roughness", [0.14, 0.3, 1.0])
def test_ggx_microfacets_cover_the_surface_once(roughness):
    """Projected areas of the microfacets add up to the surface: integral of D (n.h) over directions = 1."""
    directions, weight = hemisphere()
    one = np.ones_like(weight)
    # With n.l = n.v = 1 the visibility term is 0.5 / (2 (1 - a) + 2 a) = 1/4, which leaves D.
    distribution = 4.0 * ggx_lobe(one, one, directions[2], roughness)
    assert (distribution * directions[2] * weight).sum() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("roughness", [0.14, 0.3])
@pytest.mark.parametrize("view_angle", [0.0, 0.8, 1.4])
def test_rough_lobe_reflects_no_more_than_arrives(roughness, view_angle):
    """A perfectly reflecting rough metal (F = 1) under uniform light of radiance 1 sends at most 1 to any viewer."""
    directions, weight = hemisphere(1000, 256)
    finish = Finish(f0=(1.0, 1.0, 1.0), roughness=roughness, mirror=0.0)
    normals = np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), directions.shape)
    viewer = np.broadcast_to(np.array([[np.sin(view_angle)], [0.0], [np.cos(view_angle)]]), directions.shape)
    out = (highlight(finish, normals, directions, viewer) * weight).sum(axis=1)
    # Hammon's visibility exceeds Smith's by at most some 2 % near grazing, and the grid resolves the lobe to 1 %.
    assert (out < 1.03).all()
    assert (out > 0.5).all()


def test_highlight_is_reciprocal_and_dark_from_behind():
    rng = np.random.default_rng(0)
    a, b = (v / np.linalg.norm(v, axis=0) for v in rng.normal(size=(2, 3, 200)))
    a[2], b[2] = np.abs(a[2]), np.abs(b[2])
    normals = np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), a.shape)
    finish = Finish(f0=(0.2, 0.5, 0.9), roughness=0.3, mirror=0.0)
    there, back = highlight(finish, normals, a, b) / a[2], highlight(finish, normals, b, a) / b[2]
    np.testing.assert_allclose(there, back, rtol=1e-9)
    np.testing.assert_array_equal(highlight(finish, -normals, a, b), 0.0)


@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0))
def test_tone_curve_grows_and_never_clips(radiance, more):
    """The scene's radiance stays below 10; exp(-20) is still far above double precision's last bit."""
    low, high = tone_curve(np.array([radiance, radiance + more]))
    assert 0.0 <= low < high < 1.0


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


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_without_gloss_every_point_has_one_colour(seed):
    scene = build_scene(SceneConfig(gloss=0.0, seed=seed % 1000, **SMALL))
    points, surfaces = surface_points(scene, 100, seed)
    views = views_above(scene, points, surfaces, 4, seed)
    first, *others = [scene.outgoing_radiance(points, surfaces, v) for v in views]
    for other in others:
        np.testing.assert_array_equal(other, first)


def view_variance(gloss):
    """Mean over points and channels of the variance over views of the radiance."""
    scene = build_scene(SceneConfig(gloss=gloss, **SMALL))
    points, surfaces = surface_points(scene, 300)
    radiance = [scene.outgoing_radiance(points, surfaces, v) for v in views_above(scene, points, surfaces, 8)]
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


@pytest.mark.parametrize("studio", [False, True])
def test_no_surface_reflects_more_than_arrives(studio):
    scene = build_scene(SceneConfig(studio=studio))
    rng = np.random.default_rng(0)
    local = rng.uniform(-1.0, 1.0, size=(3, 20_000))
    assert 0.0 <= scene.floor(10 * local, scene.noises[GROUND]).min()
    assert scene.floor(10 * local, scene.noises[GROUND]).max() <= 1.0
    for item, noise in zip(scene.objects, scene.noises[FIRST_SOLID:], strict=True):
        specular = mean_fresnel(max(item.finish.f0))
        diffuse = (1.0 - specular) * item.paint(local, noise)
        assert diffuse.min() >= 0.0 and diffuse.max() + specular <= 1.0


def test_seed_changes_the_textures_and_nothing_else():
    a, b = (build_scene(SceneConfig(seed=seed, **SMALL)) for seed in (0, 1))
    origins, directions = _image_rays(a.config)
    assert (a.objects, a.lamps) == (b.objects, b.lamps)
    assert np.abs(a.radiance(origins, directions) - b.radiance(origins, directions)).mean() > 1e-3


def _image_rays(config):
    xs, ys = np.meshgrid(np.arange(config.width) + 0.5, np.arange(config.height) + 0.5)
    return camera_rays(config, dome_cameras(config)[5], np.stack([xs, ys], axis=-1).reshape(-1, 2))


@pytest.mark.parametrize("studio", [False, True])
def test_the_studio_shines_and_reflects_nothing(studio):
    """What leaves a surface there is the same whether or not rays are followed off it, and it still shines."""
    scene = build_scene(SceneConfig(studio=studio, **SMALL))
    points, surfaces = surface_points(scene)
    solid = surfaces >= FIRST_SOLID
    points, surfaces = points[solid], surfaces[solid]
    directions = views_above(scene, points, surfaces, 2)
    alone, followed = (scene._outgoing(points.T, surfaces, directions[0].T, bounces) for bounces in (0, 2))
    assert np.array_equal(alone, followed) == studio
    other = scene._outgoing(points.T, surfaces, directions[1].T, 0)
    assert np.abs(other - alone).mean() > 0.01
