# SPDX-License-Identifier: Apache-2.0
"""How far photographs disagree about how bright, and of what colour, the same points are.

A point of the reconstruction is looked up in the photographs that see it. Photographs taken next to each other have
most points in common, and see them under almost the same angle. Their light differs by a shift, in stops:

- If exposure or white balance changed, by the same shift all over the picture.
- If surfaces shine, points are occluded or the sun has moved, by other shifts in other parts of the picture.

So a picture is divided into regions. The shift of a pair of photographs is the median over the regions' medians, and
its noise is how far the regions disagree. What counts is not that photographs differ, but that one differs from those
around it: brightness that changes slowly with the place is what view dependence can learn, and test views need.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nrfgs_ns.image.photograph import GAMMA, TOE

LONGEST_SIDE = 400
"""Pixels to which a photograph is averaged down where a point lies: its position is not good to the pixel."""
MOST_POINTS = 20_000
"""Of the reconstruction; of more, as many are drawn."""
CELL, NEARER = 8, 0.02
"""A point is hidden if, in its square of so many averaged pixels, another is nearer by more than this share."""
DARKEST, BRIGHTEST = 0.06, 0.94
"""Values between which a pixel tells its light: noise below, clipped above."""
REGIONS = 4
"""Along each side of a picture."""
FEWEST_POINTS, FEWEST_REGIONS = 12, 4
"""In a region, and regions of a pair."""
NEIGHBOURS, CANDIDATES = 4, 12
"""Other photographs that each is compared with, and how many of the nearest are tried."""

ENOUGH_STOPS = 0.3, 0.2, 0.2
"""By so much must photographs differ from those next to them for their exposure, log2(R/G) or log2(B/G) to be learnt.
Captures for which learning it only costs have up to 0.23 stops of exposure and 0.12 of colour; one it helps, 0.39."""
FEWEST_PAIRS, FEWEST_NEIGHBOURS = 8, 3
"""Of a capture, and of a photograph in it, to be told by."""

SMALLEST_SPREAD = 0.02
"""Stops; regions that agree by chance do not make a pair certain."""
USUAL_STOPS = 0.3, 0.1, 0.1
"""How far exposure, log2(R/G) and log2(B/G) of a photograph are from the mean's before anything is known."""


class Pairs(NamedTuple):
    """What E pairs of photographs next to each other say. Columns: mean log2 light, log2(R/G), log2(B/G)."""

    first: Tensor
    """[E]"""
    second: Tensor
    """[E]"""
    shift: Tensor
    """stops by which the second is above the first, [E, 3]"""
    spread: Tensor
    """by how many stops the picture's regions disagree, [E, 3]"""

    @property
    def beyond_neighbours(self) -> Tensor:
        """By how many stops a photograph differs from the mean of those next to it, root mean square over the
        photographs, [3]; 0 for so few pairs that they tell nothing.

        What changes slowly from place to place is small in it: light and gloss that a scene has to learn anyway.
        """
        if len(self.first) < FEWEST_PAIRS:
            return torch.zeros(3)
        count = int(torch.cat([self.first, self.second]).max()) + 1
        total, number = torch.zeros(count, 3), torch.zeros(count, 1)
        for own, sign in ((self.second, 1.0), (self.first, -1.0)):
            total.index_add_(0, own, sign * self.shift)
            number.index_add_(0, own, torch.ones(len(own), 1))
        compared = number[:, 0] >= min(FEWEST_NEIGHBOURS, int(number.max()))
        return (total[compared] / number[compared]).square().mean(dim=0).sqrt()

    @property
    def vary(self) -> bool:
        """Whether exposure or white balance changes from one photograph to the next."""
        return bool((self.beyond_neighbours >= torch.tensor(ENOUGH_STOPS)).any())


class Sighting(NamedTuple):
    """The points that one photograph shows."""

    points: Tensor
    """rows of the table of points, ascending, [M]"""
    light: Tensor
    """log2 of the light of red, green and blue, [M, 3]"""
    region: Tensor
    """of the picture, [M]"""


def sight(points: Tensor, viewmat: Tensor, K: Tensor, image: Tensor, mask: Tensor | None = None) -> Sighting:
    """Look points up in a photograph.

    Args:
        points: [N, 3].
        viewmat: world to camera, x right, y down, z forward. [4, 4]
        K: intrinsics in pixels. [3, 3]
        image: uint8, or in [0, 1]. [H, W, 3]
        mask: bool [H, W], what counts; None: everything.

    Returns:
        On the host.
    """
    height, width = image.shape[:2]
    window = max(round(max(height, width) / LONGEST_SIDE), 1)
    points, viewmat, K = (value.to(image.device, torch.float32) for value in (points, viewmat, K))
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = seen[:, 2]
    pixel = seen @ K.T
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
    """Compare photographs with those that were taken next to them.

    Args:
        sightings: of each photograph. [V]
        centers: where they were taken, [V, 3].
    """
    distance = torch.cdist(centers.double(), centers.double())
    distance.fill_diagonal_(torch.inf)
    nearest = distance.argsort(dim=1)[:, :CANDIDATES]
    done: set[tuple[int, int]] = set()
    found: list[tuple[int, int, Tensor, Tensor]] = []
    for one, candidates in enumerate(nearest.tolist()):
        neighbours = 0
        for other in candidates:
            if neighbours == NEIGHBOURS or other == one:
                break
            pair = min(one, other), max(one, other)
            shift = None if pair in done else _shift(sightings[pair[0]], sightings[pair[1]])
            neighbours += shift is not None or pair in done
            if shift is not None:
                done.add(pair)
                found.append((*pair, *shift))
    if not found:
        none = torch.zeros(0, dtype=torch.int64)
        return Pairs(none, none, torch.zeros(0, 3), torch.zeros(0, 3))
    first, second, shift, spread = zip(*found, strict=True)
    return Pairs(torch.tensor(first), torch.tensor(second), torch.stack(shift), torch.stack(spread))


def _shift(first: Sighting, second: Sighting) -> tuple[Tensor, Tensor] | None:
    """By how much the second is above the first, and how far the regions disagree, [3] each; None: too little in
    common."""
    place = torch.searchsorted(second.points, first.points).clamp_max(max(len(second.points) - 1, 0))
    if len(second.points) == 0 or len(first.points) == 0:
        return None
    common = second.points[place] == first.points
    if int(common.sum()) < FEWEST_POINTS * FEWEST_REGIONS:
        return None
    light = second.light[place[common]] - first.light[common]
    red, green, blue = light.unbind(dim=-1)
    columns = torch.stack([light.mean(dim=-1), red - green, blue - green], dim=-1)
    region, medians = first.region[common], []
    for number in region.unique().tolist():
        inside = columns[region == number]
        if len(inside) >= FEWEST_POINTS:
            medians.append(inside.median(dim=0).values)
    if len(medians) < FEWEST_REGIONS:
        return None
    regions = torch.stack(medians)
    shift = regions.median(dim=0).values
    return shift.cpu(), 1.4826 * (regions - shift).abs().median(dim=0).values.cpu()


def varies(known: Tensor) -> bool:
    """Whether known exposures (stops, NaN where unknown, [V]) differ enough to be learnt: their standard deviation."""
    there = known[torch.isfinite(known)]
    return len(there) > 1 and float(there.std(correction=0)) >= ENOUGH_STOPS[0]


def slope(pairs: Pairs, known: Tensor) -> tuple[float, float | None]:
    """What known exposures say of the photographs' brightness.

    Args:
        pairs: of the photographs.
        known: exposure of each in stops, NaN where it is not known. [V]

    Returns:
        Stops of brightness for a stop of known exposure, 0 to 1; and which share of the shifts' squares that explains,
        0 to 1. (1, None) if there are no pairs to tell it by.
    """
    expected = known[pairs.second] - known[pairs.first]
    both = torch.isfinite(expected) & (expected.abs() > 0)
    expected, seen = expected[both].double(), pairs.shift[both, 0].double()
    if len(seen) < 3:
        return 1.0, None
    factor = float((expected * seen).sum() / expected.square().sum())
    factor = min(max(factor, 0.0), 1.0)
    return factor, max(1.0 - float((seen - factor * expected).square().sum() / seen.square().sum()), 0.0)


def estimate(pairs: Pairs, known: Tensor) -> Tensor:
    """The likeliest stops of each photograph in red, green and blue, with mean 0; a start, not the last word.

    Shifts are trusted as far as the regions agree, and a photograph is near its known exposure. That keeps small what
    only adds up over many pairs: gloss that wanders with the camera.

    Args:
        pairs: of the photographs.
        known: exposure of each in stops, NaN where it is not known. [V]

    Returns:
        [V, 3].
    """
    count = len(known)
    expected = torch.zeros(count, 3, dtype=torch.float64)
    there = torch.isfinite(known)
    if there.any():
        factor, _ = slope(pairs, known)
        expected[there, 0] = factor * (known[there] - known[there].mean()).double()
    stops = torch.empty_like(expected)
    rows = torch.arange(len(pairs.first))
    difference = torch.zeros(len(rows), count, dtype=torch.float64)
    difference[rows, pairs.second], difference[rows, pairs.first] = 1.0, -1.0
    for column, usual in enumerate(USUAL_STOPS):
        weight = pairs.spread[:, column].double().clamp_min(SMALLEST_SPREAD) ** -2
        missing = pairs.shift[:, column].double() - difference @ expected[:, column]
        normal = difference.T @ (weight[:, None] * difference) + torch.eye(count, dtype=torch.float64) / usual**2
        correction = torch.linalg.solve(normal, difference.T @ (weight * missing))
        stops[:, column] = expected[:, column] + correction
    stops -= stops.mean(dim=0)
    exposure, red, blue = stops.unbind(dim=-1)  # log2(R/G), log2(B/G)
    rgb = exposure + (2 * red - blue) / 3, exposure - (red + blue) / 3, exposure + (2 * blue - red) / 3
    return torch.stack(rgb, dim=-1).float()
