# SPDX-License-Identifier: Apache-2.0
"""What is fitted: colours of samples over directions, some to train on and others that are held out.

Every set of samples is determined by its arguments and seed. Directions are unit vectors from the sample to the viewer.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nrfgs_lab.express.reflectance import (
    BrdfNetworks,
    Btf,
    angles_to_directions,
    half_difference,
    lit_color,
)
from nrfgs_ns.appearance.spherical_harmonics import num_bases, sh_bases
from nrfgs_ns.errors import InputError

UBO_RINGS = ((0, 1), (15, 6), (30, 12), (45, 18), (60, 20), (75, 24))
"""UBO2003's 81 views: (angle from the normal in degrees, evenly spaced views on that ring)."""
CAP_DEGREES = 75.0
"""The flattest view of UBO2003, hence the flattest held-out one."""
LIGHT = (30, 0)
"""Where the light is in the measured set-ups: angle from the normal, azimuth."""
TILT_DEGREES = 15.0
"""Largest tilt of a sample's normal: with views to 75 degrees, every view stays above the horizon."""
SYNTHETIC_DEVIATION = 0.07
"""Deviation of the synthetic coefficients. The paper does not give its own; with this one the best that harmonics of
degree 3 can do is 21.0 dB, and the paper has 21.1."""
CHUNK = 4000
"""Samples shaded at a time, to bound memory."""


@dataclass
class Targets:
    """S samples over D training and E held-out directions."""

    directions: Tensor
    """training directions [D, 3]"""
    colors: Tensor
    """colours there [S, D, 3]"""
    held_out_directions: Tensor
    """[E, 3]"""
    held_out_colors: Tensor
    """[S, E, 3]"""

    def __len__(self) -> int:
        return len(self.colors)

    def to(self, device: str) -> "Targets":
        """The same on another device."""
        tensors = self.directions, self.colors, self.held_out_directions, self.held_out_colors
        return Targets(*(tensor.to(device) for tensor in tensors))


def fibonacci_sphere(count: int, cap_degrees: float = 180.0) -> Tensor:
    """Evenly spread unit vectors [count, 3] within `cap_degrees` of z: equal steps of height, golden azimuths."""
    index = torch.arange(count, dtype=torch.double) + 0.5
    z = 1.0 - (1.0 - math.cos(math.radians(cap_degrees))) * index / count
    phi = index * math.pi * (3.0 - math.sqrt(5.0))
    s = (1.0 - z.square()).clamp_min(0.0).sqrt()
    return torch.stack([s * phi.cos(), s * phi.sin(), z], dim=-1).float()


def random_cap(count: int, cap_degrees: float, generator: torch.Generator) -> Tensor:
    """Unit vectors [count, 3], uniform within `cap_degrees` of z."""
    u, v = torch.rand(2, count, dtype=torch.double, generator=generator)
    z = 1.0 - (1.0 - math.cos(math.radians(cap_degrees))) * u
    s, phi = (1.0 - z.square()).clamp_min(0.0).sqrt(), 2.0 * math.pi * v
    return torch.stack([s * phi.cos(), s * phi.sin(), z], dim=-1).float()


def ubo_views() -> Tensor:
    """The 81 directions from which UBO2003 was photographed, [81, 3]."""
    return angles_to_directions((theta, step * 360 / count) for theta, count in UBO_RINGS for step in range(count))


def synthetic(
    seed: int,
    samples: int = 328,
    directions: int = 96,
    held_out: int = 256,
    degree: int = 5,
    grey: bool = False,
    factors: int | None = None,
    by_degree: tuple[float, ...] | None = None,
    lobes: int | None = None,
    scattered: bool = False,
    deviation: float = SYNTHETIC_DEVIATION,
) -> Targets:
    """Random harmonics: 1/2 + sum_j k_j Y_j(d), k ~ N(0, deviation^2), for each sample and channel.

    With `by_degree` or `lobes` the coefficients are scaled together until those of degrees 4 and 5 have that deviation:
    harmonics of degree 3 do as well as before, and what changes is how much the other models can make of the rest.

    Args:
        seed: determines coefficients and held-out directions.
        samples, directions, held_out: how many. Training directions are evenly spread over the sphere, held-out ones
            are random.
        degree: highest degree.
        grey: the three channels share their coefficients.
        factors: the coefficients of all samples and channels lie in a random subspace of this many dimensions, with
            the same deviation. None: they are independent.
        by_degree: factor on the deviation of each degree from 0 on. None: 1 for all.
        lobes: each sample is a sum of so many impulses in random directions, of random height for each channel, cut
            off above `degree`. None: no lobes, random coefficients.
        scattered: training directions are random, as the held-out ones.
        deviation: of each coefficient.
    """
    generator = torch.Generator().manual_seed(seed)
    size = (num_bases(degree), 1 if grey else 3)
    if lobes is not None:
        axes = random_cap(samples * lobes, 180.0, generator)
        heights = torch.rand(samples, lobes, size[1], generator=generator)
        coefficients = torch.einsum("slb,slc->sbc", sh_bases(degree, axes).unflatten(0, (samples, lobes)), heights)
    elif factors is None:
        coefficients = torch.randn(samples, *size, generator=generator)
    else:
        mixing = torch.randn(factors, *size, generator=generator) / math.sqrt(factors)
        coefficients = torch.einsum("sf,fbc->sbc", torch.randn(samples, factors, generator=generator), mixing)
    if by_degree is not None:
        coefficients = (
            coefficients * torch.tensor(by_degree).repeat_interleave(2 * torch.arange(degree + 1) + 1)[:, None]
        )
    if by_degree is not None or lobes is not None:
        coefficients = coefficients / coefficients[:, num_bases(3) :].square().mean().sqrt()
    coefficients = deviation * coefficients.expand(-1, -1, 3)
    train, test = fibonacci_sphere(directions), random_cap(held_out, 180.0, generator)
    if scattered:
        train = random_cap(directions, 180.0, generator)

    def colors(at: Tensor) -> Tensor:
        return 0.5 + torch.einsum("db,sbc->sdc", sh_bases(degree, at), coefficients)

    return Targets(train, colors(train), test, colors(test))


def measured_pixels(
    networks: BrdfNetworks,
    seed: int,
    samples: int = 328,
    directions: int | None = None,
    held_out: int = 256,
    gloss: tuple[float, float] = (0.0, 1.0),
) -> Targets:
    """Unrelated samples: each a random measured material with a random normal, under one light.

    Args:
        networks: the materials.
        seed: determines materials, normals (uniform within 15 degrees of z) and held-out directions.
        samples, held_out: how many. Held-out directions are random within 75 degrees of z.
        directions: how many training directions, evenly spread within 75 degrees. None: UBO2003's 81.
        gloss: which materials are used, as for `materials_by_gloss`.
    """
    generator = torch.Generator().manual_seed(seed)
    allowed = materials_by_gloss(networks, *gloss)
    materials = allowed[torch.randint(len(allowed), (samples,), generator=generator)]
    normals = random_cap(samples, TILT_DEGREES, generator)
    surfaces = Surfaces(materials[:, None], torch.ones(samples, 1), normals, torch.ones(samples))
    train = ubo_views() if directions is None else fibonacci_sphere(directions, CAP_DEGREES)
    test = random_cap(held_out, CAP_DEGREES, generator)
    return Targets(train, shade(networks, surfaces, train), test, shade(networks, surfaces, test))


def measured_image(
    networks: BrdfNetworks,
    seed: int,
    side: int = 400,
    cells: int = 60,
    directions: int | None = None,
    held_out: int = 64,
    gloss: tuple[float, float] = (0.0, 1.0),
) -> Targets:
    """A picture of neighbouring samples: patches of measured materials on a bumpy surface, under one light.

    Voronoi cells with a random material each, blended linearly with the nearest neighbour along their borders; a smooth
    random relief tilts the normals by up to 15 degrees, a smooth random field dims the reflectance to between 60 and
    100 %.

    Args:
        networks: the materials.
        seed: determines everything random.
        side: pixels along an edge; side^2 samples, row by row.
        cells: materials' patches.
        directions, held_out, gloss: as in `measured_pixels`.
    """
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(cells, 2, generator=generator)
    allowed = materials_by_gloss(networks, *gloss)
    materials = allowed[torch.randint(len(allowed), (cells,), generator=generator)]
    axis = (torch.arange(side) + 0.5) / side
    points = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).view(-1, 2)
    near, which = torch.cdist(points, centers).topk(2, dim=-1, largest=False)
    first = (0.5 + (near[:, 1] - near[:, 0]) / 0.04).clamp_max(1.0)  # borders 2 % of the edge wide on either side
    slopes = torch.stack([smooth_noise(side, 24, generator), smooth_noise(side, 24, generator)], dim=-1).view(-1, 2)
    steepest = slopes.norm(dim=-1).max().clamp_min(1e-6)
    slopes = slopes * (math.tan(math.radians(TILT_DEGREES)) / steepest)
    normals = torch.nn.functional.normalize(torch.cat([slopes, torch.ones(len(slopes), 1)], dim=-1), dim=-1)
    paint = smooth_noise(side, 40, generator).view(-1)
    paint = 0.6 + 0.4 * (paint - paint.min()) / (paint.max() - paint.min()).clamp_min(1e-6)
    surfaces = Surfaces(materials[which], torch.stack([first, 1.0 - first], dim=-1), normals, paint)
    train = ubo_views() if directions is None else fibonacci_sphere(directions, CAP_DEGREES)
    test = random_cap(held_out, CAP_DEGREES, generator)
    return Targets(train, shade(networks, surfaces, train), test, shade(networks, surfaces, test))


def materials_by_gloss(networks: BrdfNetworks, least: float, most: float) -> Tensor:
    """Indices, increasing, of the materials between two quantiles of how much their colour changes with the view.

    Quantiles are in [0, 1]: everything for 0 and 1, a single material where they are equal.
    """
    count = len(networks)
    flat = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3)
    surfaces = Surfaces(torch.arange(count)[:, None], torch.ones(count, 1), flat, torch.ones(count))
    order = shade(networks, surfaces, ubo_views()).var(dim=1).sum(-1).argsort()
    return order[round(least * (count - 1)) : round(most * (count - 1)) + 1].sort().values


def smooth_noise(side: int, knots: int, generator: torch.Generator) -> Tensor:
    """Random field [side, side]: bicubic through `knots` x `knots` standard normal numbers."""
    coarse = torch.randn(1, 1, knots, knots, generator=generator)
    return torch.nn.functional.interpolate(coarse, size=(side, side), mode="bicubic", align_corners=True)[0, 0]


@dataclass
class Surfaces:
    """What S samples are made of."""

    materials: Tensor
    """indices of the materials that a sample mixes, [S, P]"""
    weights: Tensor
    """their shares, [S, P]"""
    normals: Tensor
    """unit normals [S, 3]"""
    paint: Tensor
    """factor on the reflectance, [S]"""


def shade(networks: BrdfNetworks, surfaces: Surfaces, directions: Tensor) -> Tensor:
    """Display colours [S, D, 3] of surfaces seen from directions [D, 3] under the light at LIGHT."""
    light = angles_to_directions([LIGHT])[0]
    out = torch.empty(len(surfaces.normals), len(directions), 3)
    for rows in torch.arange(len(out)).split(CHUNK):
        normals = surfaces.normals[rows]
        coordinates = half_difference(normals[:, None], light, directions)
        brdf = torch.zeros(len(rows), len(directions), 3)
        for part in range(surfaces.materials.shape[1]):
            materials, weights = surfaces.materials[rows, part], surfaces.weights[rows, part]
            for material in materials[weights > 0].unique().tolist():
                of = ((materials == material) & (weights > 0)).nonzero()[:, 0]
                brdf[of] += weights[of, None, None] * networks.brdf(material, coordinates[of])
        out[rows] = lit_color(
            surfaces.paint[rows, None, None] * brdf, (normals @ light)[:, None].expand(brdf.shape[:2])
        )
    return out


def from_btf(btf: Btf, seed: int, samples: int | None = None, side: int = 400) -> Targets:
    """Samples from photographs: texels of one material under one light. Every fifth view is held out.

    Args:
        btf: the photographs.
        seed: determines which texels are taken, and at which of the views the counting starts.
        samples: take so many random texels. None: all of the middle `side` x `side`, or of the whole if that is less.

    Raises:
        InputError: fewer than five views, or fewer texels than `samples`.
    """
    if len(btf.views) < 5:
        raise InputError(f"The BTF has {len(btf.views)} views under this light; at least 5 are needed to hold one out.")
    height, width = btf.images.shape[1:3]
    if samples is None:
        side = min(side, height, width)
        top, left = (height - side) // 2, (width - side) // 2
        texels = btf.images[:, top : top + side, left : left + side].reshape(len(btf.views), -1, 3)
    elif samples > height * width:
        raise InputError(f"The BTF has {height * width} texels, but {samples} samples are asked for.")
    else:
        chosen = torch.randperm(height * width, generator=torch.Generator().manual_seed(seed))[:samples]
        texels = btf.images.reshape(len(btf.views), -1, 3)[:, chosen]
    texels = texels.transpose(0, 1).contiguous()
    held = torch.arange(len(btf.views)) % 5 == seed % 5
    return Targets(btf.directions[~held], texels[:, ~held], btf.directions[held], texels[:, held])
