# SPDX-License-Identifier: Apache-2.0
"""Every quantity from a splat's numbers to Adam's state: its range, what happens at both ends, and what holds it there.

    python tests/helpers/stability_catalogue.py                    # run every check, print the table

Float32, CPU, a second or two. The named tests are where each row is pinned down; the check here shows it.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

sys.path += [str(Path(__file__).resolve().parents[1] / folder) for folder in ("rasterizer", "fixtures")]

from gsplat_call import rasterization
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from nrfgs_ns.appearance import nrf
from nrfgs_ns.appearance.head import base_colors
from nrfgs_ns.rasterizer import Projection, ProjectionOptions, project
from nrfgs_ns.rasterizer.torch_cpu.projection import LARGEST_RADIUS, MIN_QUATERNION
from nrfgs_ns.training.guard import MAX_GRADIENT

HEAD, RASTER = "tests/appearance/test_stability_head.py", "tests/rasterizer/test_stability_rasterizer.py"
GUARD, PROJECTION = "tests/training/test_guard.py", "tests/rasterizer/test_rasterization.py"
SIDE = 16
"""Pixels along a side of the image that the checks draw."""
SHAPE = {"means": [0.0, 0.0, 2.0], "quats": [1.0, 0.0, 0.0, 0.0], "scales": [0.1] * 3}


@dataclass
class Quantity:
    """One row of the catalogue; `tests` are FILE::FUNCTION."""

    name: str
    range: str
    low: str
    """what happens at the lower end (or at zero)"""
    high: str
    tests: tuple[str, ...]
    check: Callable[[], bool]


def finite(*tensors: Tensor) -> bool:
    """Whether all numbers are finite."""
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)


def draw(**changed: list[float] | float) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Opacity [H, W] and colour [H, W, 3] of one splat at depth 2, and its tensors with gradients."""
    values = SHAPE | {"opacities": 0.5, "colors": [0.5] * 3}
    splat = {name: torch.tensor([changed.get(name, value)]).requires_grad_() for name, value in values.items()}
    image, alpha, _ = rasterization(*splat.values(), *camera())
    (image.sum() + alpha.sum()).backward()
    return alpha[0, ..., 0].detach(), image[0].detach(), splat


def camera() -> tuple[Tensor, Tensor, int, int]:
    """View matrix, intrinsics and size of a small camera at the origin."""
    K = torch.tensor([[SIDE, 0.0, SIDE / 2], [0.0, SIDE, SIDE / 2], [0.0, 0.0, 1.0]])
    return torch.eye(4)[None], K[None], SIDE, SIDE


def sees(mode: str = "classic", **changed: list[float]) -> Projection:
    """Projection of one splat."""
    splat = (torch.tensor([changed.get(name, value)]) for name, value in SHAPE.items())
    return project(*splat, *camera(), ProjectionOptions(mode))


def within_one(**changed: list[float]) -> bool:
    """Whether a splat's antialiasing factor is in [0, 1]."""
    factors = sees("antialiased", **changed).compensations
    return len(factors) == 1 and bool(((factors >= 0) & (factors <= 1)).all())


def harmless(**changed: list[float] | float) -> bool:
    """Whether a splat leaves image and gradients finite."""
    alpha, image, splat = draw(**changed)
    return finite(alpha, image, *(value.grad for value in splat.values()))


def field(latent: float = 0.1, weight: float = 1.0, distance: float = 2.0) -> bool:
    """Whether the field is finite, in range and has finite gradients, for latents and weights of a size."""
    torch.manual_seed(0)
    head: nrf.NeuralResidualField = nrf.NrfConfig(output_init="default", implementation="torch").setup()
    with torch.no_grad():
        for weights in head.parameters():
            weights *= weight
    splats = {**head.splat_params(torch.rand(4, 3)), "means": torch.zeros(4, 3), "opacities": torch.zeros(4, 1)}
    splats["latents"] = torch.randn(4, 32) * latent
    splats = {name: value.requires_grad_() for name, value in splats.items()}
    colors, opacities = head(splats, torch.arange(4), torch.tensor([distance, 0.0, 0.0]))
    residual = colors.detach() - base_colors(splats["features_dc"]).detach()
    (colors.sum() + opacities.sum()).backward()
    within = bool((residual.abs() <= 0.2 + 1e-6).all() and (opacities >= 0).all() and (opacities <= 1).all())
    return within and finite(*(value.grad for value in [*splats.values(), *head.parameters()]))


def opacity_ends() -> bool:
    """Whether every bound keeps opacities of logits from -1e4 to 1e4 within [0, 1]."""
    logits = torch.tensor([[-1e4], [-20.0], [0.0], [20.0], [1e4]])
    ends = torch.ones(5, 1)
    bounded = [nrf.bounded_opacity(logits, t, 0.2, b) for b in nrf.OPACITY_BOUNDS for t in (-ends, ends)]
    return all(bool(((x >= 0) & (x <= 1)).all()) for x in bounded)


def adam_at(gradient: float) -> bool:
    """Whether Adam's second moment stays finite under a gradient of this size."""
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([parameter], eps=1e-15)
    parameter.grad = torch.tensor([gradient])
    optimizer.step()
    return finite(parameter, optimizer.state[parameter]["exp_avg_sq"])


def geometry(means: list[float]) -> tuple[Tensor, Tensor]:
    """Direction and log distance from a mean to a camera at the origin."""
    return nrf.view_geometry(torch.tensor([means]), torch.zeros(3), 0.01)


CATALOGUE = [
    Quantity(
        "mean x",
        "any",
        "1e-6: nothing special. Depth below 0.01: not drawn, no gradient",
        "depth above 1e10, or NaN or infinite: not drawn, no gradient; the guard names it",
        (
            f"{RASTER}::test_depths_from_the_lens_to_beyond_the_far_plane",
            f"{RASTER}::test_far_to_the_side",
            f"{RASTER}::test_coordinates_of_1e_6_and_1e6",
        ),
        lambda: all(harmless(means=[x, 0.0, z]) for x in (0.0, 3e38) for z in (0.0, 2.0, 1e20, math.nan)),
    ),
    Quantity(
        "quaternion q",
        "any length",
        "shorter than 1e-15: no direction, not drawn; derivative 1/|q| above",
        "longer than 1e19: its square overflows, not drawn",
        (f"{RASTER}::test_quaternions_of_any_length",),
        lambda: all(harmless(quats=[s, 0.0, 0.0, s]) for s in (0.0, MIN_QUATERNION, 1e-10, 1e10, 1e25)),
    ),
    Quantity(
        "scale exp(s)",
        "[0, inf]; s in [-40, 20] is drawn right",
        "0: a point, the blur of 0.3 px alone",
        f"an even veil of its own opacity; wider than {LARGEST_RADIUS:.0e} px: not drawn",
        (
            f"{RASTER}::test_log_scales_from_minus_40_to_plus_20",
            f"{RASTER}::test_a_splat_of_planetary_size_is_an_even_veil",
            f"{RASTER}::test_a_splat_without_extent_is_a_point_of_blur",
        ),
        lambda: all(harmless(scales=[math.exp(s)] * 3) for s in (-40, 20, 88)) and harmless(scales=[math.inf] * 3),
    ),
    Quantity(
        "opacity logit",
        "any, infinite too",
        "below -104: opacity exactly 0; below -17 the slope is under 1e-7 and the splat hardly comes back",
        "above 17: opacity exactly 1, slope exactly 0",
        (f"{HEAD}::test_opacity_logits_to_both_ends", f"{HEAD}::test_opacity_rises_with_its_logit"),
        lambda: torch.sigmoid(torch.tensor([-104.0, 17.0])).tolist() == [0.0, 1.0],
    ),
    Quantity(
        "base colour c",
        "any; white is 1",
        "below 0: clamped at 0 after the residual, no gradient below",
        "not bounded above; finite to 1e18. Not finite: the splat is not drawn, the guard names it",
        (
            f"{HEAD}::test_coordinates_latents_and_base_colours",
            f"{RASTER}::test_large_colours",
            f"{RASTER}::test_a_splat_that_is_not_finite_is_not_there",
        ),
        lambda: harmless(colors=[1e15] * 3) and harmless(colors=[math.nan] * 3),
    ),
    Quantity(
        "latent z",
        "any to 1e20",
        "0: colour and direction alone speak",
        "tanh saturates: residual at its bound, gradient 0. Beside weights, |z||W|^2 must stay below 1e38",
        (f"{HEAD}::test_coordinates_latents_and_base_colours", f"{HEAD}::test_latents_and_weights_together"),
        lambda: field(latent=1e20) and field(latent=1e4, weight=1e4),
    ),
    Quantity(
        "direction d",
        "|d| <= 1",
        "camera within distance_eps: d shrinks to 0 with slope 1/eps",
        "|v| above 1e18 a coordinate: held there, no gradient",
        (
            "tests/appearance/test_head.py::test_a_camera_on_the_splat_gives_finite_values_and_gradients",
            f"{HEAD}::test_direction_distance_and_bands_agree_with_float64",
        ),
        lambda: (
            finite(*geometry([0.0] * 3), *geometry([1e30, 0.0, 0.0]))
            and bool(geometry([1e30, 1e30, 0.0])[0].norm() <= 1 + 1e-6)
        ),
    ),
    Quantity(
        "log distance log r",
        "[log eps, 42]",
        "floored at log eps, no gradient below",
        "42 = log(sqrt(3) 1e18); it enters the network as it is",
        (
            f"{HEAD}::test_distances_from_1e_30_to_1e30",
            f"{HEAD}::test_log_distance_rises_with_distance",
            f"{HEAD}::test_beyond_the_farthest_nothing_moves_any_more",
        ),
        lambda: abs(geometry([0.0] * 3)[1].item() - math.log(0.01)) < 1e-6 and geometry([3e38] * 3)[1].item() < 42.01,
    ),
    Quantity(
        "band argument 2^k pi d",
        "+-2^k pi",
        "0: sin 0, cos 1",
        "rounding grows with 2^k: 2^k pi 10 units, 8e-6 for band 2",
        (f"{HEAD}::test_direction_distance_and_bands_agree_with_float64",),
        lambda: bool(
            (nrf.fourier_bands(torch.ones(1, 3), 3)[1].double() - nrf.fourier_bands(torch.ones(1, 3).double(), 3)[1])
            .abs()
            .max()
            < 8e-6
        ),
    ),
    Quantity(
        "low branch, high branch",
        "finite while |z||W|^2 < 1e38",
        "zero output layers: residual exactly 0",
        "beyond: saturated, or NaN (infinity minus infinity, by the order in which a machine adds); then the guard "
        "stops the training before the optimisers step and names the learning rate",
        (
            f"{HEAD}::test_the_field_agrees_with_float64",
            f"{HEAD}::test_latents_and_weights_together",
            f"{GUARD}::test_weights_that_overflow_stop_the_training",
        ),
        lambda: field(weight=0.0) and field(weight=1e4),
    ),
    Quantity(
        "gate sigmoid(w), tanh",
        "[0, 1], [-1, 1]",
        "w below -104: the high branch is off and hears nothing",
        "saturated: value exact, gradient 0, never NaN",
        (f"{HEAD}::test_latents_and_weights_together",),
        lambda: finite(torch.tanh(torch.tensor([-3e38, 3e38])), torch.sigmoid(torch.tensor([-3e38, 3e38]))),
    ),
    Quantity(
        "composed colour",
        "[0, inf), within 0.2 of c",
        "clamped at 0",
        "the image is clamped at 1, without gradient above",
        (f"{HEAD}::test_latents_and_weights_together", f"{HEAD}::test_coordinates_latents_and_base_colours"),
        field,
    ),
    Quantity(
        "composed opacity",
        "[0, 1]",
        "base + residual below 0: opacity 0; what gradient is left is opacity_bound's choice",
        "above 1: opacity 1, likewise",
        (f"{HEAD}::test_opacity_rises_with_its_logit", f"{HEAD}::test_opacity_logits_to_both_ends"),
        opacity_ends,
    ),
    Quantity(
        "projected centre, depth",
        "depth in [0.01, 1e10]",
        "depth 0.01: centre up to f |x| / 0.01 px",
        "overflow: not drawn",
        (f"{RASTER}::test_far_to_the_side", f"{RASTER}::test_depths_from_the_lens_to_beyond_the_far_plane"),
        lambda: len(sees(means=[0.0, 0.0, 0.0099]).radii) == 0 and len(sees(means=[0.0, 0.0, 0.01]).radii) == 1,
    ),
    Quantity(
        "conic",
        "[0, 1 / 0.3] per px^2",
        "0 for a splat beyond 4e9 px: taken as flat",
        "1 / 0.3 for a point: the blur bounds it",
        (
            f"{RASTER}::test_a_splat_of_planetary_size_is_an_even_veil",
            f"{RASTER}::test_log_scales_from_minus_40_to_plus_20",
        ),
        lambda: (
            bool((sees(scales=[0.0] * 3).conics <= 1 / 0.3 * (1 + 1e-6)).all())
            and finite(sees(scales=[1e15] * 3).conics)
        ),
    ),
    Quantity(
        "antialiasing factor",
        "[0, 1]",
        "0 for a point, or a flat splat seen from its edge: the root's slope is held",
        "1 for a splat on the lens: gradients are right to rounding",
        (
            f"{PROJECTION}::test_flat_splat_has_finite_gradients",
            f"{PROJECTION}::test_gradients_of_compensations_near_the_camera",
        ),
        lambda: within_one(scales=[0.0] * 3) and within_one(means=[0.0, 0.0, 0.01], scales=[1e3] * 3),
    ),
    Quantity(
        "alpha",
        "0 or [1/255, 0.999]",
        "below 1/255: not drawn, no gradient",
        "capped at 0.999, no gradient at the cap. Not finite: not drawn",
        (f"{RASTER}::test_opacities_to_both_ends", f"{RASTER}::test_opacity_of_the_image_rises_with_a_splats"),
        lambda: (
            bool((draw(opacities=1 / 256)[0] == 0).all())
            and bool(draw(opacities=1.0, scales=[1e6] * 3)[0].max() < 0.9991)
        ),
    ),
    Quantity(
        "transmittance T",
        "[1e-4, 1]",
        "the splat that would take T to 1e-4 or below ends the ray",
        "1 where nothing is drawn",
        (
            f"{RASTER}::test_light_runs_out_behind_many_opaque_splats",
            f"{RASTER}::test_images_of_one_pixel_and_scenes_of_no_splat",
        ),
        lambda: bool((draw(means=[0.0, 0.0, -1.0])[0] == 0).all()),
    ),
    Quantity(
        "loss",
        "[0, 1.2] for images in [0, 1]",
        "0: gradient of |.| is 0 there",
        "not finite: the guard stops the training and names the image",
        (f"{GUARD}::test_the_likely_cause", f"{GUARD}::test_a_condemned_last_step_is_reported_too"),
        lambda: torch.autograd.grad((x := torch.zeros(1, requires_grad=True)).abs().sum(), x)[0].item() == 0.0,
    ),
    Quantity(
        "gradient",
        f"to {MAX_GRADIENT:.1e}",
        "0 for what is not drawn",
        "beyond, or not finite: the guard stops the training; parameters and moments stay as they were",
        (
            f"{GUARD}::test_a_condemned_step_leaves_parameters_and_moments_as_they_were",
            f"{GUARD}::test_large_gradients_that_adam_can_square_pass",
        ),
        lambda: bool((draw(means=[0.0, 0.0, -1.0])[2]["means"].grad == 0).all()),
    ),
    Quantity(
        "Adam's moments",
        f"second moment to {MAX_GRADIENT**2:.1e}",
        "both 0: the step is 0 / 1e-15, that is 0",
        "finite by the limit on gradients; a checkpoint with NaN or infinity is neither written nor read",
        (
            f"{GUARD}::test_large_gradients_that_adam_can_square_pass",
            f"{GUARD}::test_weights_or_all_splats_that_are_not_finite_are_never_written_nor_read",
        ),
        lambda: adam_at(0.0) and adam_at(MAX_GRADIENT) and not adam_at(1e22),
    ),
]


def main() -> None:
    """Run every check and print the catalogue; exit status 1 if one fails."""
    table = Table("quantity", "range", "lower end", "upper end", "check", title="Numbers at their extremes")
    results = [q.check() for q in CATALOGUE]
    for q, holds in zip(CATALOGUE, results, strict=True):
        table.add_row(*(escape(cell) for cell in (q.name, q.range, q.low, q.high)), "holds" if holds else "FAILS")
    Console().print(table)
    raise SystemExit(0 if all(results) else 1)


if __name__ == "__main__":
    tyro.cli(main)
