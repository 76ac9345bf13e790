# SPDX-License-Identifier: Apache-2.0
"""Cameras on a dome, and the pictures that they take."""

import math

import numpy as np

from .config import SceneConfig
from .geometry import Array
from .scene import Scene
from .shading import tone_curve

DISTANCE = 4.3  # Mean distance from the cameras to the target, world units; each camera's own is within 8 %.
TARGET = (0.0, 0.0, 0.35)  # Point that the cameras look at, give or take a jitter of 0.1, world units.
ELEVATIONS = (14.0, 52.0)  # Lowest and highest elevation seen from the target, degrees.
RAYS_AT_ONCE = 1 << 14  # Rays traced together: temporaries of this length stay in a core's cache.


def dome_cameras(config: SceneConfig) -> Array:
    """Camera-to-world matrices [views, 4, 4], float64, OpenGL axes: x right, y up, looking along -z; world z is up.

    View i climbs from the lowest to the highest elevation, evenly in the sine (equal areas), while the azimuth turns by
    the silver ratio, sqrt(2) - 1 of the arc. The more usual golden angle would not do here: 8 is a Fibonacci
    number, so every 8th view - the test views - would crowd on one side.
    """
    # The scene's noise is drawn from the same seed: a second stream keeps cameras and textures independent.
    rng = np.random.default_rng([config.seed, 1])
    low, high = (math.sin(math.radians(angle)) for angle in ELEVATIONS)
    start = rng.uniform()
    matrices = np.empty((config.views, 4, 4))
    for i in range(config.views):
        azimuth = 2.0 * math.pi * start + math.radians(config.arc) * (i * (math.sqrt(2.0) - 1.0) % 1.0)
        height = low + (high - low) * (i + 0.5) / config.views
        across = math.sqrt(1.0 - height * height)
        outward = np.array([across * math.cos(azimuth), across * math.sin(azimuth), height])
        position = np.asarray(TARGET) + DISTANCE * rng.uniform(0.92, 1.08) * outward
        matrices[i] = look_at(position, np.asarray(TARGET) + rng.uniform(-0.1, 0.1, size=3))
    return matrices


def look_at(position: Array, target: Array) -> Array:
    """Camera-to-world matrix [4, 4] of an upright camera at `position` [3] looking at `target` [3], not vertically."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return matrix


def camera_rays(config: SceneConfig, camera_to_world: Array, pixels: Array) -> tuple[Array, Array]:
    """Origins [N, 3] and directions [N, 3] (not unit) of rays through image positions, float32.

    Args:
        camera_to_world: [4, 4] or [N, 4, 4], OpenGL axes.
        pixels: [N, 2], (x, y) from the left and top edge of the image; the centre of the first pixel is (0.5, 0.5).
    """
    x = (pixels[:, 0] - 0.5 * config.width) / config.focal_length
    y = (0.5 * config.height - pixels[:, 1]) / config.focal_length
    local = np.stack([x, y, -np.ones_like(x)], axis=1)
    directions = np.einsum("...ij,...j->...i", camera_to_world[..., :3, :3], local)
    origins = np.broadcast_to(camera_to_world[..., :3, 3], directions.shape)
    return origins.astype(np.float32), directions.astype(np.float32)


def project(config: SceneConfig, camera_to_world: Array, points: Array) -> tuple[Array, Array]:
    """Image positions [N, 2] (as in `camera_rays`) of world points [N, 3], and their depths [N] along the view axis."""
    local = (points - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
    depth = -local[:, 2]
    pixels = config.focal_length * local[:, :2] / depth[:, None] * (1.0, -1.0)
    return pixels + (0.5 * config.width, 0.5 * config.height), depth


def render(scene: Scene, camera_to_world: Array) -> Array:
    """The picture [height, width, 3] of one camera, display values in [0, 1), float32.

    A pixel is the mean of samples x samples rays. The mean is taken after the tone curve: images are fitted, and splats
    composited, in display values, and the mean of linear radiance would leave jagged edges around bright highlights.
    """
    config = scene.config
    side = config.samples
    xs = (np.arange(config.width * side) + 0.5) / side
    ys = (np.arange(config.height * side) + 0.5) / side
    pixels = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    values = np.empty((len(pixels), 3), dtype=np.float32)
    for first in range(0, len(pixels), RAYS_AT_ONCE):
        chunk = slice(first, first + RAYS_AT_ONCE)
        values[chunk] = tone_curve(scene.radiance(*camera_rays(config, camera_to_world, pixels[chunk])))
    return values.reshape(config.height, side, config.width, side, 3).mean(axis=(1, 3))
