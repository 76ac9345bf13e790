# SPDX-License-Identifier: Apache-2.0
"""Intersections, normals, shadows and openness against definitions that share no code with them."""

import numpy as np
import pytest

from nrfgs_ns.scenes.geometry import CAMERA, FIRST_SOLID, GROUND, SKY, Box, Sphere, World, smoothstep

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


def test_world_normals_face_free_space():
    points = np.array([[10.0, 0.0, 0.0], [2.0, 2.0, 0.0], [0.3, -0.2, 1.4]])
    normals = WORLD.normals(points.T, np.array([SKY, GROUND, FIRST_SOLID])).T
    np.testing.assert_allclose(normals, [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]], atol=1e-15)


def test_shadow_is_full_through_the_middle_none_in_the_open_and_soft_between():
    lamp = np.array([0.3, -0.2, 5.0])
    points = np.array([[0.3, -0.2, 0.0], [4.0, 4.0, 0.0]] + [[0.3 + x, -0.2, 0.0] for x in np.linspace(0.0, 1.2, 50)])
    towards = lamp - points
    distance = np.linalg.norm(towards, axis=1)
    leaving = np.full(len(points), GROUND)
    share = WORLD.shadow(points.T, (towards / distance[:, None]).T, distance, leaving, softness=0.35)
    assert share[0] == 0.0 and share[1] == 1.0
    rim = share[2:]
    assert (np.diff(rim) >= 0.0).all() and rim[0] == 0.0 and rim[-1] == 1.0
    assert ((rim > 0.05) & (rim < 0.95)).any()


def test_shadow_ignores_solids_behind_the_lamp_and_the_lit_solid_itself():
    point, up = np.array([[0.3, -0.2, 0.0]]).T, np.array([[0.0, 0.0, 1.0]]).T
    below_the_sphere = np.array([1e-3])
    ground, sphere = np.array([GROUND]), np.array([FIRST_SOLID])
    # The sphere touches the ground here, so at most 1e-3 of it lies before the lamp: smoothstep(1e-3 / 0.35) < 3e-5.
    assert WORLD.shadow(point, up, below_the_sphere, ground, softness=0.35)[0] > 1.0 - 3e-5
    assert WORLD.shadow(point, up, np.array([5.0]), sphere, softness=0.35)[0] == 1.0


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


def test_box_counts_as_the_ball_of_its_volume():
    assert 4.0 / 3.0 * np.pi * BOX.ball_radius**3 == pytest.approx(8 * 0.3 * 0.4 * 0.5)


def test_smoothstep_ends():
    np.testing.assert_array_equal(smoothstep(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0.0, 0.0, 0.5, 1.0, 1.0])
