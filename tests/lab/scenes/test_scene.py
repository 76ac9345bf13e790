# SPDX-License-Identifier: Apache-2.0
"""Procedural scenes: geometry, shading, and all together."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nrfgs_lab.scenes import SceneConfig, build_scene, camera_rays, dome_cameras
from nrfgs_lab.scenes.geometry import CAMERA, FIRST_SOLID, GROUND, SKY, Box, Sphere, World

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
