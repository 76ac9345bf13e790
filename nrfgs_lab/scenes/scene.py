# SPDX-License-Identifier: Apache-2.0
"""A scene that can be asked for the colour along any ray, and the one layout that this package ships."""

import math
from dataclasses import dataclass, replace

import numpy as np

from .config import SceneConfig
from .geometry import CAMERA, FIRST_SOLID, GROUND, SKY, Array, Box, Solid, Sphere, World, column, dot, normalize
from .shading import Ambient, Finish, Lamp, fresnel, highlight, mean_fresnel, mirror_direction
from .textures import Paint, Sky, Waves, checkered_floor

BOUNCES = 2
"""Mirror reflections that are followed. After the last, a mirror shows the ambient light, as a rough surface would."""


@dataclass(frozen=True)
class Object:
    """A solid with its paint (diffuse) and finish (specular)."""

    solid: Solid
    paint: Paint
    finish: Finish


@dataclass(frozen=True)
class Scene:
    """Objects on a floor under lamps and a luminous sky dome; `shading.py` states the reflectance model.

    The sky and a diffuse floor look the same from everywhere at every gloss. Queries have the precision of the rays.
    """

    config: SceneConfig
    world: World
    objects: tuple[Object, ...]
    lamps: tuple[Lamp, ...]
    ambient: Ambient
    sky: Sky
    noises: tuple[Waves, ...]  # One noise for each surface: sky, ground, objects in order.
    floor_finish: Finish | None = None  # None: perfectly diffuse.
    shadow_softness: float = 0.35

    def first_hit(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Points [N, 3] that rays see first, and their surfaces [N]: SKY, GROUND, FIRST_SOLID + k for object k.

        Args:
            origins, directions: [N, 3], float32 or float64, world units; origins inside the dome, above the ground and
                outside the objects. Directions of any length > 0.
        """
        o, d = origins.T, normalize(directions.T)
        distance, surface = self.world.first_hit(o, d, np.full(o.shape[1], CAMERA))
        return (o + distance * d).T, surface

    def radiance(self, origins: Array, directions: Array) -> Array:
        """Linear RGB radiance [N, 3] that arrives along rays; arguments as in `first_hit`."""
        o, d = origins.T, normalize(directions.T)
        return self._trace(o, d, np.full(o.shape[1], CAMERA), BOUNCES).T

    def outgoing_radiance(self, points: Array, surfaces: Array, directions: Array) -> Array:
        """The scene's known reflectance: linear RGB radiance [N, 3] that leaves surface points towards `directions`.

        Args:
            points: [N, 3] on the surfaces numbered by `surfaces` [N], as `first_hit` returns them.
            directions: [N, 3], away from the surface, of any length > 0.
        """
        return self._outgoing(points.T, surfaces, normalize(directions.T), BOUNCES).T

    def _trace(self, origins: Array, directions: Array, leaving: Array, bounces: int) -> Array:
        distance, surface = self.world.first_hit(origins, directions, leaving)
        return self._outgoing(origins + distance * directions, surface, -directions, bounces)

    def _outgoing(self, points: Array, surfaces: Array, towards_viewer: Array, bounces: int) -> Array:
        """L(x, v) of shading.py, [3, N]; `bounces` is the number of mirror reflections still to follow."""
        result = np.empty_like(points)
        is_sky = surfaces == SKY
        if is_sky.any():
            result[:, is_sky] = self.sky(normalize(points[:, is_sky]), self.noises[SKY])
        lit = np.flatnonzero(~is_sky)
        if lit.size:
            result[:, lit] = self._reflected(points[:, lit], surfaces[lit], towards_viewer[:, lit], bounces)
        return result

    def _reflected(self, points: Array, surfaces: Array, towards_viewer: Array, bounces: int) -> Array:
        normals = self.world.normals(points, surfaces)
        arriving = [self._arriving(lamp, points, normals, surfaces) for lamp in self.lamps]

        irradiance = self.ambient.irradiance(normals) * self.world.openness(points, normals, surfaces)
        for to_lamp, facing in arriving:
            irradiance += np.maximum(dot(normals, to_lamp), 0.0) * facing

        result = np.empty_like(points)
        for number in np.unique(surfaces):
            here = np.flatnonzero(surfaces == number)
            if number == GROUND:
                finish, paint = self.floor_finish, checkered_floor(points[:, here], self.noises[GROUND])
            else:
                item = self.objects[number - FIRST_SOLID]
                finish = item.finish
                paint = item.paint(item.solid.local(points[:, here]), self.noises[number])
            diffuse = paint * irradiance[:, here] / np.pi
            if finish is None or self.config.gloss == 0.0:  # trace nothing that would be multiplied by zero
                result[:, here] = diffuse
                continue
            lights = [(to_lamp[:, here], facing[:, here]) for to_lamp, facing in arriving]
            specular = self._specular(
                finish, number, points[:, here], normals[:, here], towards_viewer[:, here], lights, bounces
            )
            taken = self.config.gloss * mean_fresnel(max(finish.f0))
            result[:, here] = (1.0 - taken) * diffuse + self.config.gloss * specular
        return result

    def _arriving(self, lamp: Lamp, points: Array, normals: Array, surfaces: Array) -> tuple[Array, Array]:
        """Unit directions [3, N] to a lamp, and its irradiance [3, N] on a plane that faces it, shadows included."""
        towards = column(lamp.position, points.dtype) - points
        squared = dot(towards, towards)
        distance = np.sqrt(squared)
        to_lamp = towards / distance
        share = np.zeros_like(distance)
        front = np.flatnonzero(dot(normals, to_lamp) > 0.0)  # the rest is in its own shade
        share[front] = self.world.shadow(
            points[:, front], to_lamp[:, front], distance[front], surfaces[front], self.shadow_softness
        )
        return to_lamp, column(lamp.intensity, points.dtype) * (share / squared)

    def _specular(
        self,
        finish: Finish,
        surface: int,
        points: Array,
        normals: Array,
        towards_viewer: Array,
        lights: list[tuple[Array, Array]],
        bounces: int,
    ) -> Array:
        """Rough lobe plus mirror of one object, [3, N], before the gloss dial."""
        reflectance = fresnel(column(finish.f0, points.dtype), np.clip(dot(normals, towards_viewer), 0.0, 1.0))
        bounced = mirror_direction(normals, towards_viewer)
        blurred = self.ambient.irradiance(bounced) / np.pi

        rough = reflectance * blurred
        for to_lamp, facing in lights:
            rough += highlight(finish, normals, to_lamp, towards_viewer) * facing
        if finish.mirror == 0.0:  # trace nothing that would be multiplied by zero
            return rough
        sharp = self._trace(points, bounced, np.full(points.shape[1], surface), bounces - 1) if bounces else blurred
        return (1.0 - finish.mirror) * rough + finish.mirror * reflectance * sharp


SATIN = Finish((0.3, 0.3, 0.3), roughness=0.12, mirror=0.0)
"""The finish of all objects in the studio, and of its floor."""


def studio_lamps() -> tuple[Lamp, ...]:
    """Twelve lamps of all hues, spread over the dome by the golden angle, 6 world units from the middle."""
    lamps = []
    for i in range(12):
        angle = 2.0 * math.pi * (i * 0.5 * (math.sqrt(5.0) - 1.0) % 1.0)
        height = 0.25 + 0.7 * (i + 0.5) / 12
        across = math.sqrt(1.0 - height**2)
        red, green, blue = (6.5 + 3.25 * math.cos(angle - channel * 2.0 * math.pi / 3.0) for channel in range(3))
        position = 6.0 * across * math.cos(angle), 6.0 * across * math.sin(angle), 6.0 * height
        lamps.append(Lamp(position, (red, green, blue)))
    return tuple(lamps)


def build_scene(config: SceneConfig) -> Scene:
    """The shipped layout: five spheres and a box on a checkered floor, three coloured lamps, a dome of soft light."""
    objects = (
        Object(  # chrome
            Sphere((0.05, 0.30, 0.66), 0.66),
            Paint((0.54, 0.56, 0.60), (0.86, 0.87, 0.88), (0.0, 0.0, 4.0)),
            Finish((0.88, 0.89, 0.91), roughness=0.16, mirror=0.9),
        ),
        Object(  # gold
            Sphere((-1.05, -0.50, 0.42), 0.42),
            Paint((0.66, 0.34, 0.05), (0.95, 0.66, 0.18), (3.0, 3.0, 0.0)),
            Finish((0.97, 0.58, 0.19), roughness=0.26, mirror=0.7),
        ),
        Object(  # lacquer
            Sphere((1.02, -0.42, 0.50), 0.50),
            Paint((0.42, 0.01, 0.015), (0.95, 0.13, 0.05), (0.0, 0.0, 3.0)),
            Finish((0.09, 0.09, 0.09), roughness=0.14, mirror=0.8),
        ),
        Object(  # jade
            Sphere((0.05, -1.00, 0.30), 0.30),
            Paint((0.01, 0.20, 0.14), (0.14, 0.58, 0.30), (2.0, 0.0, 2.0)),
            Finish((0.08, 0.08, 0.08), roughness=0.22, mirror=0.6),
        ),
        Object(  # pearl
            Sphere((1.05, 0.78, 0.26), 0.26),
            Paint((0.66, 0.53, 0.70), (0.97, 0.91, 0.93), (0.0, 3.0, 0.0)),
            Finish((0.30, 0.28, 0.34), roughness=0.30, mirror=0.4),
        ),
        Object(  # tiles
            Box((-0.92, 0.82, 0.48), (0.40, 0.40, 0.48), yaw=0.45),
            Paint((0.01, 0.04, 0.26), (0.06, 0.30, 0.60), (2.5, 2.5, 2.5)),
            Finish((0.14, 0.14, 0.15), roughness=0.18, mirror=0.8),
        ),
    )
    lamps = (
        Lamp((3.2, -2.6, 4.6), (66.0, 50.0, 32.0)),  # warm key
        Lamp((-4.2, -1.6, 3.4), (7.0, 11.0, 23.0)),  # cool fill
        Lamp((0.4, 4.4, 2.8), (14.0, 4.0, 9.0)),  # rose rim
    )
    rng = np.random.default_rng(config.seed)
    noises = [Waves.random(rng, (2.5, 5.0, 9.0)), Waves.random(rng, (3.0, 7.0, 15.0))]  # sky, ground
    noises += [Waves.random(rng, (2.0, 4.0, 8.0)) for _ in objects]  # per object, in its local units
    # The sky glows behind each lamp, in its colour, with a peak radiance of 6 in its strongest channel.
    directions = [np.divide(lamp.position, np.linalg.norm(lamp.position)) for lamp in lamps]
    glows = [np.multiply(6.0, lamp.intensity) / max(lamp.intensity) for lamp in lamps]
    return Scene(
        config=config,
        world=World(sky_radius=10.0, solids=tuple(item.solid for item in objects)),
        objects=tuple(replace(item, finish=SATIN) for item in objects) if config.studio else objects,
        lamps=studio_lamps() if config.studio else lamps,
        ambient=Ambient(below=(0.08, 0.07, 0.06), above=(0.17, 0.18, 0.26)),
        floor_finish=SATIN if config.studio else None,
        sky=Sky(
            horizon=(0.56, 0.37, 0.27),
            zenith=(0.10, 0.10, 0.27),
            patches=tuple(zip(directions, glows, strict=True)),
        ),
        noises=tuple(noises),
    )
