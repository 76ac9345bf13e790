# SPDX-License-Identifier: Apache-2.0
"""Exposure and white balance of photographs, estimated from the points that they share.

Neighbouring photographs share most points of the reconstruction, seen under almost the same angle. If exposure or white
balance changed, their light differs by the same shift, in stops, all over the image; if surfaces shine, points are
occluded or the sun has moved, the shift varies. So an image is divided into regions: the shift of a pair of photographs
is the median over the regions' medians, and its noise is their spread. Differences that the camera positions explain do
not count (`estimate`).
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import spsolve
from torch import Tensor

from nrfgs_ns.image.photograph import GAMMA, TOE

LONGEST_SIDE = 400
"""Pixels of the longest side after averaging around each point, whose position is not exact to the pixel."""
MOST_POINTS = 20_000
"""Points of the reconstruction; a larger one is sampled."""
CELL, NEARER = 8, 0.02
"""Side of a cell, in averaged pixels; a point is hidden if another in its cell is nearer by more than this share."""
DARKEST, BRIGHTEST = 0.06, 0.94
"""Range of usable pixel values: noise below, clipping above."""
REGIONS = 4
"""Regions along each side of an image."""
FEWEST_POINTS, FEWEST_REGIONS = 12, 4
"""Minimum points in a region, and regions of a pair."""
NEIGHBOURS, CANDIDATES = 4, 12
"""Photographs that each is compared with, and nearest ones that are tried."""
ENOUGH_STOPS = 0.12, 0.06, 0.06
"""Minimum spread of exposure, log2(R/G) or log2(B/G) between photographs, beyond what their positions explain, for them
to be learnt. Captures that do not need it have up to 0.05 stops of exposure and 0.02 of colour; one that does, 0.26."""
ENOUGH_KNOWN_STOPS = 0.3
"""Minimum spread of EXIF exposures, in stops."""
FEWEST_PAIRS = 8
"""Minimum number of pairs needed to decide."""
MOST_PHOTOGRAPHS = 1000
"""Larger captures: the spread is estimated from the first 1,000, and only the mean is held; the cost is cubic."""
SMALLEST_SPREAD = 0.02
"""Smallest noise of a pair, in stops: regions that agree by chance do not make it certain."""
USUAL_STOPS = 0.3, 0.1, 0.1
"""Spread of exposure, log2(R/G) and log2(B/G) assumed where there are too few pairs."""
SIZES = tuple(0.01 * 1.5**step for step in range(12))
"""Candidate spreads between photographs and between positions, in stops: 0.01 to 0.86."""
SCALES = 2.0, 8.0, 32.0
"""Candidate distances over which brightness changes with the position, in camera spacings."""
MOST_PATTERNS = 128
"""Maximum number of held patterns in a column."""


class Pairs(NamedTuple):
    """Shifts of E pairs of neighbouring photographs. Columns: mean log2 light, log2(R/G), log2(B/G)."""

    first: Tensor
    second: Tensor
    """rows of the photographs, [E]"""
    shift: Tensor
    """stops by which the second is above the first, [E, 3]"""
    spread: Tensor
    """disagreement of the image's regions, in stops, [E, 3]"""


class Sighting(NamedTuple):
    """Points seen in one photograph."""

    points: Tensor
    """rows of the table of points, ascending, [M]"""
    light: Tensor
    """log2 of the light of red, green and blue, [M, 3]"""
    region: Tensor
    """of the image, [M]"""


def sight(points: Tensor, viewmat: Tensor, K: Tensor, image: Tensor, mask: Tensor | None = None) -> Sighting:
    """Sample a photograph at points [N, 3]; the result is on the host.

    Args:
        viewmat: world to camera, x right, y down, z forward. [4, 4]
        K: intrinsics in pixels. [3, 3]
        image: uint8, or in [0, 1]. [H, W, 3]
        mask: bool [H, W], True inside; None: everywhere.
    """
    height, width = image.shape[:2]
    window = max(round(max(height, width) / LONGEST_SIDE), 1)
    points, viewmat, K = (value.to(image.device, torch.float32) for value in (points, viewmat, K))
    # Not as matrix products: cuBLAS would keep 32 MiB of a GPU for each thread that asks for one.
    seen = (points[:, None] * viewmat[:3, :3]).sum(dim=-1) + viewmat[:3, 3]
    depth = seen[:, 2]
    pixel = (seen[:, None] * K).sum(dim=-1)
    x, y = pixel[:, 0] / depth, pixel[:, 1] / depth
    rows = ((depth > 0) & (x >= window) & (x < width - window) & (y >= window) & (y < height - window)).nonzero()[:, 0]
    x, y, depth = x[rows].long(), y[rows].long(), depth[rows]
    side = CELL * window
    cell = (y // side) * (width // side + 1) + x // side
    nearest = depth.new_full(((height // side + 1) * (width // side + 1),), torch.inf)
    nearest.scatter_reduce_(0, cell, depth, "amin")
    visible = depth <= nearest[cell] * (1 + NEARER)
    if mask is not None:
        visible &= mask.to(image.device)[y, x]
    rows, x, y = rows[visible], x[visible], y[visible]
    colors = torch.zeros(len(rows), 3, device=image.device)
    around = range(-(window // 2), window - window // 2)
    for down in around:
        for across in around:
            colors += image[y + down, x + across]
    colors /= window**2 * (255 if image.dtype == torch.uint8 else 1)
    good = ((colors > DARKEST) & (colors < BRIGHTEST)).all(dim=-1)
    light = GAMMA * torch.log2((colors[good] + TOE) / (1 + TOE))
    region = (REGIONS * y[good] // height) * REGIONS + REGIONS * x[good] // width
    return Sighting(rows[good].cpu(), light.cpu(), region.cpu())


def drawn(points: Tensor) -> Tensor:
    """At most MOST_POINTS of the points [N, 3], the same ones each time."""
    if len(points) <= MOST_POINTS:
        return points
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return points[order[:MOST_POINTS].sort().values.to(points.device)]


def compare(sightings: Sequence[Sighting], centers: Tensor) -> Pairs:
    """Compare photographs, from their sightings [V] and camera centres [V, 3], with those taken next to them."""
    distance = torch.cdist(centers.double(), centers.double())
    distance.fill_diagonal_(torch.inf)
    order = distance.argsort(dim=1)[:, : min(CANDIDATES, len(centers) - 1)].tolist()
    nearest = [[(min(a, b), max(a, b)) for b in row] for a, row in enumerate(order)]
    shift_of = functools.cache(lambda pair: _shift(*(sightings[photograph] for photograph in pair)))
    compared = {}  # on one thread: the operations are small, and several threads would wait for Python's lock
    for row in nearest:
        usable = (pair for pair in row if shift_of(pair) is not None)
        compared |= {pair: shift_of(pair) for pair in itertools.islice(usable, NEIGHBOURS)}
    if not compared:
        return Pairs(*torch.zeros(2, 0, dtype=torch.int64), *torch.zeros(2, 0, 3))
    return Pairs(*torch.tensor(list(compared)).T, *map(torch.stack, zip(*compared.values(), strict=True)))


def _shift(first: Sighting, second: Sighting) -> tuple[Tensor, Tensor] | None:
    """Shift from the first to the second and disagreement of the regions, [3] each; None: too few common points."""
    points = first.points.numpy(), second.points.numpy()
    _, here, there = np.intersect1d(*points, assume_unique=True, return_indices=True)
    if len(here) < FEWEST_POINTS * FEWEST_REGIONS:
        return None
    light = second.light[there] - first.light[here]
    red, green, blue = light.unbind(dim=-1)
    columns = torch.stack([light.mean(dim=-1), red - green, blue - green], dim=-1)
    region, order = first.region[here].sort()
    inside = columns[order].split(region.bincount().tolist())
    medians = [lights.median(dim=0).values for lights in inside if len(lights) >= FEWEST_POINTS]
    if len(medians) < FEWEST_REGIONS:
        return None
    regions = torch.stack(medians)
    shift = regions.median(dim=0).values
    return shift, 1.4826 * (regions - shift).abs().median(dim=0).values


def spread(known: Tensor) -> float:
    """Standard deviation of known exposures (stops, NaN where unknown, [V]); 0 where none is known."""
    there = known[torch.isfinite(known)]
    return float(there.std(correction=0)) if len(there) else 0.0


def slope(pairs: Pairs, known: Tensor) -> float:
    """Stops of brightness for one of known exposure ([V], NaN: unknown), by regression, 0 to 1; 1 with too few
    pairs."""
    expected = known[pairs.second] - known[pairs.first]
    both = torch.isfinite(expected) & (expected.abs() > 0)
    expected, seen = expected[both].double(), pairs.shift[both, 0].double()
    if len(seen) < 3:
        return 1.0
    return min(max(float((expected * seen).sum() / expected.square().sum()), 0.0), 1.0)


class Looks(NamedTuple):
    """Exposure before a training. Columns: exposure, log2(R/G), log2(B/G)."""

    stops: Tensor
    """maximum-likelihood value of each photograph, mean 0, [V, 3]"""
    held: tuple[Tensor, Tensor, Tensor]
    """for each column, orthonormal patterns over the photographs that are the scene's, with the constant, [V, K]"""
    random: tuple[float, float, float]
    """standard deviation between photographs beyond what positions explain, in stops; 0 with too few pairs"""


def estimate(pairs: Pairs, known: Tensor, centers: Tensor) -> Looks:
    """Separate photographs' exposures from brightness that changes with the camera's position.

    A photograph's brightness is d = s + g: its exposure s, independent for each photograph (variance a), and a part g
    that changes slowly with the position (a Gaussian process over the cameras, covariance b exp(-distance / scale)):
    light, gloss, and exposure that follows the scene. a, b and the scale maximise the likelihood of the pairs' shifts;
    b = 0 unless Schwarz's criterion favours b > 0. Patterns with more variance in g than in s belong to the scene.

    Args:
        known: exposures in stops, NaN where unknown. [V]
        centers: of the cameras. [V, 3]
    """
    count = len(known)
    expected = torch.zeros(count, 3, dtype=torch.float64)
    there = torch.isfinite(known)
    expected[there, 0] = slope(pairs, known) * (known[there] - known[there].mean()).double()
    usual = USUAL_STOPS
    random = [0.0, 0.0, 0.0]
    places = None
    if count > MOST_PHOTOGRAPHS:
        first = (pairs.first < MOST_PHOTOGRAPHS) & (pairs.second < MOST_PHOTOGRAPHS)
        part = Pairs(*(value[first] for value in pairs))
        random = list(estimate(part, known[:MOST_PHOTOGRAPHS], centers[:MOST_PHOTOGRAPHS]).random)
        usual = random if any(random) else usual
    elif len(pairs.first) >= FEWEST_PAIRS:
        places = _places(centers)
    size = len(pairs.first)
    ones = np.ones(size)
    ends = np.tile(np.arange(size), 2), torch.cat([pairs.second, pairs.first]).numpy()
    difference = csr_array((np.concatenate([ones, -ones]), ends), shape=(size, count))
    stops = torch.empty_like(expected)
    held = []
    for column in range(3):
        weight = pairs.spread[:, column].double().clamp_min(SMALLEST_SPREAD).numpy() ** -2
        missing = pairs.shift[:, column].double().numpy() - difference @ expected[:, column].numpy()
        precision = difference.T @ difference.multiply(weight[:, None]).tocsr()
        seen = difference.T @ (weight * missing)
        # mean of s given the pairs: cov(s, d) (cov(d) + precision^-1)^-1, written without inverting the precision
        if places is None:
            variance = usual[column] ** 2
            patterns = _constant(count)
            own = torch.from_numpy(spsolve((eye_array(count) + variance * precision).tocsc(), seen))
        else:
            precision, seen = torch.from_numpy(precision.toarray()), torch.from_numpy(seen)
            variance, total, patterns = _split(places, precision, seen)
            random[column] = math.sqrt(variance)
            own = torch.linalg.solve(torch.eye(count, dtype=torch.float64) + precision @ total, seen)
        stops[:, column] = expected[:, column] + variance * own
        held.append(patterns.float())
    stops -= stops.mean(dim=0)
    return Looks(stops.float(), tuple(held), tuple(random))


def _constant(count: int) -> Tensor:
    return torch.full((count, 1), count**-0.5, dtype=torch.float64)


def _places(centers: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Covariance of g at each scale, of variance 1 and mean 0: eigenvalues [V], falling, and eigenvectors [V, V]."""
    distance = torch.cdist(centers.double(), centers.double())
    spacing = distance.sort(dim=1).values[:, 1 : 1 + NEIGHBOURS].mean().clamp_min(1e-12)
    bases = []
    for scale in SCALES:
        covariance = torch.exp(-distance / (scale * spacing))
        covariance = covariance - covariance.mean(dim=0) - covariance.mean(dim=1, keepdim=True) + covariance.mean()
        values, vectors = torch.linalg.eigh(covariance)
        bases.append((values.flip(0).clamp_min(0.0), vectors.flip(1)))
    return bases


def _split(places: list[tuple[Tensor, Tensor]], precision: Tensor, seen: Tensor) -> tuple[float, Tensor, Tensor]:
    """Variance of s, covariance of d, patterns of g; likeliest brightness: precision [V, V] @ d = seen [V]."""
    count = len(seen)
    eye = torch.eye(count, dtype=torch.float64)
    own_precision = precision.diagonal().clamp_min(1e-9)
    brightness = torch.linalg.solve(precision + 1e-6 * own_precision.mean() * eye, seen)
    noise = float((1.0 / own_precision).median())
    best, highest = None, -math.inf
    for shares, basis in places:
        squares = (basis.T @ brightness).square()
        for own, place in itertools.product(SIZES, (0.0, *SIZES)):
            variance = place**2 * shares + own**2 + noise
            likelihood = -float((variance.log() + squares / variance)[:-1].sum())
            likelihood -= 2 * math.log(count) * (place > 0.0)
            if likelihood > highest:
                best, highest = (own**2, place**2 * shares, basis), likelihood
    own, slow, basis = best
    patterns = torch.cat([_constant(count), basis[:, (slow > own).nonzero()[:MOST_PATTERNS, 0]]], dim=1)
    return own, own * eye + (basis * slow) @ basis.T, torch.linalg.qr(patterns).Q
