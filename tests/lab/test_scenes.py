# SPDX-License-Identifier: Apache-2.0
"""Procedural scenes: geometry and shading; and the written data set, which nerfstudio reads."""

import dataclasses

import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from nrfgs_lab.scenes import SceneConfig, build_scene, camera_rays, dome_cameras, write_scene
from nrfgs_lab.scenes.cameras import project
from nrfgs_lab.scenes.dataset import sparse_points, split_names
from nrfgs_lab.scenes.geometry import CAMERA, FIRST_SOLID, GROUND, SKY, Box, Sphere, World
from nrfgs_lab.scenes.shading import tone_curve
from nrfgs_ns.data.points import read_ply

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


def random_rays(count, seed=0):
    """Rays from a shell about the scene towards its middle, so that about half of them hit something. [N, 3] each."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins = 4.0 * origins / np.linalg.norm(origins, axis=1, keepdims=True)
    origins[:, 2] = np.abs(origins[:, 2]) + 0.01
    directions = rng.uniform(-1.0, 1.0, size=(count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("solid, signed_distance", [(SPHERE, signed_distance_sphere), (BOX, signed_distance_box)])
def test_normals_are_unit_and_the_gradient_of_distance(solid, signed_distance):
    origins, directions = random_rays(400)
    enter, leave = solid.interval(origins.T, directions.T)
    hit = enter < leave
    points = origins[hit] + enter[hit, None] * directions[hit]
    normals = solid.normals(points.T).T
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    steps = 1e-5 * np.eye(3)
    gradient = np.stack([signed_distance(points + step) - signed_distance(points - step) for step in steps], 1) / 2e-5
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


MATT = SceneConfig(gloss=0.0, views=10, width=96, height=72, points=1500, samples=1)
GLOSSY = SceneConfig(gloss=1.0, views=9, width=24, height=18, points=50)


@pytest.fixture(scope="module")
def matt(tmp_path_factory):
    return write_scene(MATT, tmp_path_factory.mktemp("scenes") / "matt")


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    return write_scene(GLOSSY, tmp_path_factory.mktemp("scenes") / "glossy")


def test_pictures_are_what_nerfstudios_rays_see(matt):
    """Through every pixel centre, with the split that was meant."""
    options = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    parser = NerfstudioDataParserConfig(data=matt, load_3D_points=False, **options).setup()
    scene = build_scene(MATT)
    for split, expected in zip(("train", "test"), split_names(MATT), strict=True):
        outputs = parser.get_dataparser_outputs(split)
        names = [path.relative_to(matt).as_posix() for path in outputs.image_filenames]
        assert names == expected
        rays = outputs.cameras.generate_rays(camera_indices=1)
        seen = scene.radiance(*(vectors.reshape(-1, 3).numpy() for vectors in (rays.origins, rays.directions)))
        # To a byte, except at edges, where rounding decides which side a ray falls on.
        image = np.asarray(Image.open(matt / names[1])) / 255.0
        off = np.abs(tone_curve(seen).reshape(72, 96, 3) - image).max(axis=-1) > 0.55 / 255
        assert off.mean() < 2e-3, off.mean()


def test_points_lie_where_pictures_show_them(matt):
    """Without gloss a point has its colour in every view, and in the picture where it is projected to."""
    points, colours = read_ply(matt / "sparse.ply")
    scene, seen = build_scene(MATT), 0
    for camera in dome_cameras(MATT):
        pixels, depth = project(MATT, camera, points)
        inside = (depth > 0) & (pixels > 0).all(axis=1) & (pixels < (96, 72)).all(axis=1)
        origins, directions = (a.astype(np.float64) for a in camera_rays(MATT, camera, pixels[inside]))
        hits, _ = scene.first_hit(origins, directions)
        here = np.linalg.norm(hits - points[inside], axis=1) < 1e-3
        shown = tone_curve(scene.radiance(origins[here], directions[here]))
        seen += here.sum()
        # Half a byte of rounding, and a texture's change within the tolerance of a hit.
        assert np.abs(shown - colours[inside][here] / 255.0).mean() < 0.5 / 255
    assert seen > 5000


def test_rerun_is_identical_to_the_byte_and_points_come_from_training_views_alone(glossy, tmp_path):
    again = write_scene(GLOSSY, tmp_path / "deep" / "again")
    first = {p.relative_to(glossy): p.read_bytes() for p in glossy.rglob("*") if p.is_file()}
    assert first == {p.relative_to(again): p.read_bytes() for p in again.rglob("*") if p.is_file()}
    assert len(first) == GLOSSY.views + 3
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["again"]  # nothing of the staging is left
    points, colours = read_ply(glossy / "sparse.ply")
    training = np.delete(dome_cameras(GLOSSY), [0, 8], axis=0)
    expected_points, expected_colours = sparse_points(build_scene(GLOSSY), training)
    np.testing.assert_array_equal(points, expected_points)
    np.testing.assert_array_equal(colours, np.rint(255.0 * expected_colours))


def test_other_content_is_refused(glossy, tmp_path):
    tiny = SceneConfig(views=2, width=4, height=3, samples=1, points=5)
    with pytest.raises(FileExistsError, match=r"glossy exists and is not this procedural scene\. Choose another"):
        write_scene(dataclasses.replace(GLOSSY, gloss=0.5), glossy)
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "holiday.jpg").touch()
    for place in (photos, photos / "holiday.jpg"):
        with pytest.raises(FileExistsError, match=f"{place.name} exists and is not this .*delete this one"):
            write_scene(tiny, place)
    (tmp_path / "empty").mkdir()
    assert (write_scene(tiny, tmp_path / "empty") / "scene.json").is_file()
