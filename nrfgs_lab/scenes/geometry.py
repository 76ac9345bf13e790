# SPDX-License-Identifier: Apache-2.0
"""Where rays meet the world: a ground plane, a few convex solids on it, and a sky dome around everything.

The world is closed: every ray from inside the dome hits something at a finite distance. Rays carry the number of the
surface that they leave, and skip it: no convex solid, plane or dome seen from inside can be hit twice in a row, so
neither shadows nor reflections need the usual offset along the normal.

Vectors are stored component first, [3, N], because numpy is fast along the last axis. z points up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Array = np.ndarray

CAMERA, SKY, GROUND, FIRST_SOLID = -1, 0, 1, 2
"""Surface numbers. Solid k of a scene is surface FIRST_SOLID + k; CAMERA marks rays that leave no surface."""


def dot(a: Array, b: Array) -> Array:
    """Inner products over the leading axis: [3, N] (or [3, 1]) with [3, N] to [N]."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalize(a: Array) -> Array:
    """[3, N] to unit length."""
    return a / np.sqrt(dot(a, a))


def column(values: Sequence[float], dtype: np.dtype) -> Array:
    """Three numbers as a [3, 1] array that broadcasts over rays."""
    return np.asarray(values, dtype=dtype)[:, None]


@dataclass(frozen=True)
class Sphere:
    """A sphere: |p - middle| = radius."""

    middle: tuple[float, float, float]
    radius: float

    @property
    def ball_radius(self) -> float:
        """Radius of the ball of the same volume, world units."""
        return self.radius

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Ray parameters [N] at which the infinite line enters and leaves the body; enter > leave on a miss."""
        # |o + t d - c|^2 = r^2 with |d| = 1 is t^2 + 2 b t + c = 0. The discriminant b^2 - c is computed from the
        # distance of the centre to the line, r^2 - |m - b d|^2, which does not cancel for far, small spheres.
        m = origins - column(self.middle, origins.dtype)
        b = dot(m, directions)
        miss = m - b * directions
        half_chord_squared = self.radius**2 - dot(miss, miss)
        half_chord = np.sqrt(np.maximum(half_chord_squared, 0.0))
        return np.where(half_chord_squared > 0.0, -b - half_chord, np.inf), half_chord - b

    def local(self, points: Array) -> Array:
        """World points [3, N] in the body's frame, in which its surface lies within [-1, 1] on each axis."""
        return (points - column(self.middle, points.dtype)) / self.radius

    def normals(self, points: Array) -> Array:
        """Outward unit normals [3, N] at surface points [3, N]."""
        return normalize(self.local(points))


@dataclass(frozen=True)
class Box:
    """A box with sides 2 half_sides, turned by yaw radians about the vertical."""

    middle: tuple[float, float, float]
    half_sides: tuple[float, float, float]
    yaw: float

    @property
    def ball_radius(self) -> float:
        return (0.75 * (8.0 * float(np.prod(self.half_sides))) / np.pi) ** (1.0 / 3.0)

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        o = self.local(origins)
        d = self._turn(directions, -self.yaw) / column(self.half_sides, directions.dtype)
        # In its own frame the box is the cube [-1, 1]^3, the meeting of three slabs. An axis along which the ray does
        # not move gets a tiny speed instead of a division by zero: it then enters "at once" or never.
        d = np.where(np.abs(d) < 1e-20, 1e-20, d)
        a, b = (-1.0 - o) / d, (1.0 - o) / d
        return np.minimum(a, b).max(axis=0), np.maximum(a, b).min(axis=0)

    def local(self, points: Array) -> Array:
        return self._turn(points - column(self.middle, points.dtype), -self.yaw) / column(self.half_sides, points.dtype)

    def normals(self, points: Array) -> Array:
        local = self.local(points)
        face = np.abs(local).argmax(axis=0)[None]  # the axis whose slab boundary the point lies on
        outward = np.zeros_like(local)
        np.put_along_axis(outward, face, np.sign(np.take_along_axis(local, face, axis=0)), axis=0)
        return self._turn(outward, self.yaw)

    @staticmethod
    def _turn(vectors: Array, angle: float) -> Array:
        c, s = float(np.cos(angle)), float(np.sin(angle))
        return np.stack([c * vectors[0] - s * vectors[1], s * vectors[0] + c * vectors[1], vectors[2]])


Solid = Sphere | Box


@dataclass(frozen=True)
class World:
    """Everything that can be hit: the sky dome of radius `sky_radius` about the origin, the plane z = 0, the solids."""

    sky_radius: float
    solids: tuple[Solid, ...]

    def first_hit(self, origins: Array, directions: Array, leaving: Array) -> tuple[Array, Array]:
        """Distances [N] to the nearest surfaces along rays, and the surfaces' numbers [N].

        Args:
            origins: [3, N], above the ground, inside the dome, outside the solids (or on their surfaces).
            directions: [3, N], unit.
            leaving: [N] integers, the surface that the ray leaves (CAMERA when none).
        """
        _, distance = Sphere((0.0, 0.0, 0.0), self.sky_radius).interval(origins, directions)
        surface = np.full(distance.shape, SKY, dtype=np.int8)

        falling = (directions[2] < 0.0) & (leaving != GROUND)
        to_ground = np.where(falling, -origins[2] / np.where(falling, directions[2], -1.0), np.inf)
        nearer = to_ground < distance
        distance = np.where(nearer, to_ground, distance)
        surface[nearer] = GROUND

        for number, solid in enumerate(self.solids, start=FIRST_SOLID):
            enter, leave = solid.interval(origins, directions)
            nearer = (enter < leave) & (enter > 0.0) & (enter < distance) & (leaving != number)
            distance = np.where(nearer, enter, distance)
            surface[nearer] = number
        return distance, surface

    def normals(self, points: Array, surfaces: Array) -> Array:
        """Unit normals [3, N] on the side that is seen, at points [3, N] of the surfaces [N]."""
        normals = np.where(surfaces == SKY, -normalize(points), column((0.0, 0.0, 1.0), points.dtype))
        for number, solid in enumerate(self.solids, start=FIRST_SOLID):
            here = surfaces == number
            if here.any():
                normals[:, here] = solid.normals(points[:, here])
        return normals

    def shadow(self, points: Array, directions: Array, distances: Array, leaving: Array, softness: float) -> Array:
        """Share [N] of a lamp's light that arrives.

        A solid in the way lets 1 - smoothstep(chord / softness) through, where chord is the length of the line of
        sight inside it: shadows are opaque but for a soft rim, and depend on the point alone, never on a view.

        Args:
            points: [3, N] lit points; leaving: [N] their surfaces, which do not shade themselves.
            directions: [3, N] unit, towards the lamp; distances: [N] to the lamp.
            softness: chord length from which a solid is opaque, world units.
        """
        arriving = np.ones_like(distances)
        for number, solid in enumerate(self.solids, start=FIRST_SOLID):
            enter, leave = solid.interval(points, directions)
            chord = np.minimum(leave, distances) - np.maximum(enter, 0.0)
            chord[leaving == number] = 0.0
            arriving *= 1.0 - smoothstep(chord / softness)
        return arriving

    def openness(self, points: Array, normals: Array, leaving: Array) -> Array:
        """Share [N] of the ambient light that the solids leave: the product over solids of 1 - max(n.u, 0) (r / D)^2.

        (n.u) (r / D)^2 is the exact form factor of a ball of radius r at distance D in direction u that is wholly above
        the horizon; every solid counts as the ball of its volume.
        """
        share = np.ones_like(points[0])
        for number, solid in enumerate(self.solids, start=FIRST_SOLID):
            towards = column(solid.middle, points.dtype) - points
            squared = np.maximum(dot(towards, towards), solid.ball_radius**2)  # box corners reach into the ball
            factor = np.maximum(dot(normals, towards), 0.0) * solid.ball_radius**2 / squared**1.5
            share *= 1.0 - np.where(leaving == number, 0.0, factor)
        return share


def smoothstep(x: Array) -> Array:
    """3 x^2 - 2 x^3 between 0 and 1, constant outside."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
