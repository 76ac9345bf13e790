# SPDX-License-Identifier: Apache-2.0
r"""Spherical harmonics of degree 3, all that a 3DGS file can hold, fitted to any appearance head.

Training view v sees splat i from the unit direction d_v with the head's colour y_v. Its weight is the splat's
contribution to the picture,

    w_v = sum over pixels of alpha T,

from the rasterizer's derivative with respect to the colour. With base colour c, harmonics Y(d) (16) and coefficients k
(16 for each channel), which start from the base colour, k = k_c + delta,

    minimise over delta    sum_v (n w_v / W) |y_v - c - Y(d_v) delta|^2 + strength |delta|^2,

    W = sum_v w_v,    n = W^2 / sum_v w_v^2.

n is Kish's effective sample size, so the data term counts views, and `strength` is in views, too: seen once, a splat
moves 16 / (4 pi) / (16 / (4 pi) + strength) of the way from its base colour to the seen one; never seen, it keeps its
base colour. In Bayes' terms strength = (variance that degree 3 cannot show) / (variance of a coefficient), which
depends on the scene. So every eighth view is held out, the others are fitted with each of `STRENGTHS`, and the one with
the least weighted squared error on the held-out colours is used for all views. For a head that is harmonics in disguise
the smallest strength wins and the fit is exact to 1e-8 of the coefficients.

Opacity is the mean of the head's over the views that see the splat, unweighted. With the weights w_v, views in which
the splat is all but transparent would not count, and a file would show it there.
"""

import math
from typing import NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from nrfgs_ns.appearance.head import SplatAppearance, base_colors
from nrfgs_ns.appearance.sh import num_bases, sh_bases
from nrfgs_ns.progress import progress
from nrfgs_ns.rasterizer import View, contributions

DEGREE = 3
"""Degree of the harmonics in a 3DGS file."""
BASES = num_bases(DEGREE)
STRENGTHS = tuple(10.0**power for power in range(-8, 3))
"""Ridges to choose from, in views. The lowest is far above float64's rounding, the highest leaves the base colour."""
LONE_STRENGTH = 1.0
"""Ridge where no view can be held out, in views."""
HOLD_OUT_EVERY = 8
TUNING_SPLATS = 1 << 14
"""Splats, evenly spread over the table, on which the strength is chosen: 60 MB."""
LONGEST_SIDE = 1600
"""Views are halved until no side is longer, in pixels, as nerfstudio's training images are by default."""
ROWS_AT_ONCE = 1 << 15
"""Rows of a view, or splats of a solution, that are computed together: a few hundred MB."""
OPAQUE = 1.0 - 1e-6
"""Largest opacity that is written: its logit is finite."""


class PlainSplats(NamedTuple):
    """N splats as in a 3DGS file, under the names of the model's tables."""

    means: Tensor
    """[N, 3], world units"""
    quats: Tensor
    """rotations (w, x, y, z) of unit length, or NaN. [N, 4]"""
    scales: Tensor
    """logarithms of the standard deviations. [N, 3]"""
    opacities: Tensor
    """logits. [N, 1]"""
    features_dc: Tensor
    """coefficients of the constant harmonic: its colour is 1/2 + SH_C0 features_dc. [N, 3]"""
    features_rest: Tensor
    """coefficients of degree 1 to 3. [N, 15, 3]"""


class Fit(NamedTuple):
    """Splats with fitted harmonics, and how the fit was made."""

    splats: PlainSplats
    exact: bool
    """the head is harmonics, which are copied"""
    strength: float | None
    """the chosen ridge, in views; None if exact"""
    views: int
    """number of training views"""
    unseen: int
    """splats that no training view sees, which keep their base colour"""


class Observations(NamedTuple):
    """M splats as seen in one view."""

    rows: Tensor
    """rows of the table, ascending. [M]"""
    weights: Tensor
    """w of the module's docstring, pixels; 0 if hidden or transparent. [M]"""
    bases: Tensor
    """harmonics of the direction from camera to splat. [M, 16]"""
    residuals: Tensor
    """the head's colour minus the base colour. [M, 3]"""
    opacities: Tensor
    """the head's opacity. [M]"""

    def where(self, keep: Tensor, rows: Tensor) -> "Observations":
        """Those with `keep` [M] True, under other row numbers [M]."""
        return Observations(rows[keep], *(value[keep] for value in self[1:]))


class Moments:
    """Weighted sums over views that determine the fit of `count` splats, in float64: 1.6 GB for a million.

    The gram matrix of directions in a narrow cone is nearly singular: float32 would need a ridge of 1e-6 views, which
    changes the coefficients by 1e-3.
    """

    def __init__(self, count: int, device: torch.device):
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(count, *shape, dtype=torch.float64, device=device)

        self.upper = torch.triu_indices(BASES, BASES, device=device)
        self.gram = zeros(self.upper.shape[1])  # sum w Y_a Y_b for a <= b
        self.target = zeros(BASES, 3)  # sum w Y residual
        self.power = zeros()  # sum w |residual|^2
        self.weight, self.weight_squared, self.opacity, self.views = (zeros() for _ in range(4))

    def add(self, seen: Observations) -> None:
        """Add a view, in which no row occurs twice."""
        self.opacity.index_add_(0, seen.rows, seen.opacities.double())
        self.views.index_add_(0, seen.rows, torch.ones_like(seen.opacities, dtype=torch.float64))
        seen = seen.where(seen.weights > 0, seen.rows)
        for first in range(0, len(seen.rows), ROWS_AT_ONCE):
            part = Observations(*(value[first : first + ROWS_AT_ONCE] for value in seen))
            weights, bases, residuals = (value.double() for value in part[1:4])
            weighted = weights[:, None] * bases
            self.gram.index_add_(0, part.rows, weighted[:, self.upper[0]] * bases[:, self.upper[1]])
            self.target.index_add_(0, part.rows, weighted[:, :, None] * residuals[:, None, :])
            self.power.index_add_(0, part.rows, weights * residuals.square().sum(dim=-1))
            self.weight.index_add_(0, part.rows, weights)
            self.weight_squared.index_add_(0, part.rows, weights.square())

    def full_gram(self, rows: slice) -> Tensor:
        """Gram matrices of some splats, [count, 16, 16]."""
        gram = self.gram[rows]
        full = gram.new_zeros(len(gram), BASES, BASES)
        full[:, self.upper[0], self.upper[1]] = gram
        full[:, self.upper[1], self.upper[0]] = gram
        return full

    def solve(self, strength: float) -> Tensor:
        """Delta of the module's docstring, [count, 16, 3]; 0 for unseen splats."""
        views_per_weight = self.weight / self.weight_squared.clamp_min(torch.finfo(torch.float64).tiny)  # n / W
        ridge = strength * torch.eye(BASES, dtype=torch.float64, device=self.gram.device)
        solution = torch.empty_like(self.target)
        for first in range(0, len(solution), ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            scale = views_per_weight[rows, None, None]
            factor = torch.linalg.cholesky(scale * self.full_gram(rows) + ridge)
            solution[rows] = torch.cholesky_solve(scale * self.target[rows], factor)
        return solution

    def squared_error(self, delta: Tensor) -> float:
        """Sum over splats and views of w |residual - Y delta|^2, for delta [count, 16, 3]."""
        quadratic = (delta * (self.full_gram(slice(None)) @ delta)).sum()
        return (self.power.sum() - 2.0 * (delta * self.target).sum() + quadratic).item()


@torch.no_grad()
def fit_harmonics(model, cameras: Cameras) -> Fit:
    """Fit harmonics of degree 3 and one opacity to each splat of a model, on its device.

    The coefficients of a head that is harmonics are copied, with zeros for the degrees that it does not have.

    Args:
        model: an NrfgsModel in evaluation mode.
        cameras: the training cameras, [V].
    """
    model.head.require_splat_colors()
    splats = {name: value.detach() for name, value in model.gauss_params.items()}
    rest = splats.get("features_rest")
    splats["quats"] = splats["quats"] / splats["quats"].norm(dim=-1, keepdim=True)
    splats["features_rest"] = splats["features_dc"].new_zeros(model.num_points, BASES - 1, 3)
    plain = PlainSplats(*(splats[name] for name in PlainSplats._fields))
    if model.head.is_harmonics:
        plain.features_rest[:, : rest.shape[1]] = rest
        return Fit(plain, exact=True, strength=None, views=0, unseen=0)

    count, device = len(plain.means), model.device
    stride = -(-count // TUNING_SPLATS)
    moments = Moments(count, device)
    kept, held_out = (Moments(-(-count // stride), device) for _ in range(2))
    hold_out_every = min(HOLD_OUT_EVERY, len(cameras))
    with progress("Fitting harmonics", len(cameras)) as advance:
        for index in range(len(cameras)):
            seen = observe(model, cameras[index : index + 1])
            moments.add(seen)
            tuning = held_out if index % hold_out_every == hold_out_every - 1 else kept
            tuning.add(seen.where(seen.rows % stride == 0, seen.rows // stride))
            advance()
    strength = choose_strength(kept, held_out)
    delta = moments.solve(strength).to(plain.means.dtype)
    mean = moments.opacity / moments.views.clamp_min(1.0)
    logits = torch.logit(mean.clamp(1.0 - OPAQUE, OPAQUE)).to(plain.means.dtype)[:, None]
    plain = plain._replace(
        opacities=torch.where(moments.views[:, None] > 0, logits, plain.opacities),
        features_dc=plain.features_dc + delta[:, 0],
        features_rest=delta[:, 1:].contiguous(),
    )
    return Fit(plain, exact=False, strength=strength, views=len(cameras), unseen=int((moments.weight == 0).sum()))


def choose_strength(kept: Moments, held_out: Moments) -> float:
    """The ridge with which a fit of the kept views predicts the held-out ones best."""
    if not (bool((kept.weight > 0).any()) and bool((held_out.weight > 0).any())):
        return LONE_STRENGTH
    return min(STRENGTHS, key=lambda strength: held_out.squared_error(kept.solve(strength)))


def observe(model, camera: Cameras) -> Observations:
    """The visible splats of one training view."""
    field = model.field
    view, appearance, weights = look_through(model, camera)
    towards = field.splats["means"].index_select(0, view.visible) - view.center
    return Observations(
        rows=view.visible,
        weights=weights,
        bases=sh_bases(DEGREE, torch.nn.functional.normalize(towards, dim=-1)),
        residuals=appearance.colors - base_colors(field.splats["features_dc"].index_select(0, view.visible)),
        opacities=appearance.opacities,
    )


def look_through(model, camera: Cameras) -> tuple[View, SplatAppearance, Tensor]:
    """The M splats that a training view sees, their appearance, and their contributions to the picture, [M].

    Args:
        camera: a batch of one, [1]; halved as by `no_larger`.
    """
    view = model.project(no_larger(camera.to(model.device)))
    appearance = model.field.seen_from(view)
    return view, appearance, contributions(view.projection, appearance.opacities)


def no_larger(camera: Cameras) -> Cameras:
    """Halve a camera [1], in place, until no side is longer than LONGEST_SIDE pixels."""
    longest = max(int(camera.width.max()), int(camera.height.max()))
    halvings = max(math.ceil(math.log2(longest / LONGEST_SIDE)), 0)
    if halvings > 0:
        camera.rescale_output_resolution(0.5**halvings)
    return camera
