# SPDX-License-Identifier: Apache-2.0
"""The reflectance model's normalisations and closed forms, against numerical integrals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nrfgs_ns.scenes.shading import (
    Ambient,
    Finish,
    fresnel,
    ggx_lobe,
    highlight,
    mean_fresnel,
    mirror_direction,
    tone_curve,
)


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


def test_mirror_direction_keeps_the_angle_and_the_plane():
    normal = np.array([[0.0, 0.0, 1.0]]).T
    viewer = np.array([[0.6, 0.0, 0.8]]).T
    np.testing.assert_allclose(mirror_direction(normal, viewer)[:, 0], [-0.6, 0.0, 0.8], atol=1e-15)


@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0))
def test_tone_curve_grows_and_never_clips(radiance, more):
    """The scene's radiance stays below 10; exp(-20) is still far above double precision's last bit."""
    low, high = tone_curve(np.array([radiance, radiance + more]))
    assert 0.0 <= low < high < 1.0
