# SPDX-License-Identifier: Apache-2.0
"""The judge: does a rasterizer's result agree with the float64 twin, up to rounding and nothing else?

Values. `Image.rounding` bounds an image's first-order error per unit of colour range, pixel by pixel. At undecided
pixels (a cut-off within rounding error) the image may further move by `Image.jump`, the exact size of the steps that
could flip.

Gradients. The upstream gradient is 0 at undecided pixels, so no step enters. How far rounding can move each entry is
measured and not guessed: the twin is run again, in float64, with every input, every projected quantity and every
pixel's offset from a splat (`reference.HELD`) off by a random 8 rounding units, and so each gradient on its way back (8
operations deep is about what either stage is). The tolerance is 8 times the largest change in 6 such runs (the largest
of 6 normal-like draws falls short of 1/8 of the extreme once in > 1e6), plus 64 units of the tensor's largest entry for
sums over hundreds of terms. Two known losses of gsplat enter as noise too: it restores T from 1 - alpha, which costs
unit / T relative, and its determinant is a difference of products, which costs (a c / det) units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import reference
import torch
from make_gsplat_fixtures import PARAMETERS, Case
from torch import Tensor

from nrfgs_ns.host import gsplat_version

FLOAT32 = 2.0**-24
# The twin works in float64 too, and its plain matrix products lose up to 8 bits on huge or flat splats.
FLOAT64 = 2.0**-45
RUNS = 6
BOUNDS = {"cpu": "square", "cuda": "rectangle" if gsplat_version() >= (1, 5) else "square"}
"""What cuts a splat off on a device; see `reference.project`."""
devices = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])


@dataclass
class Verdict:
    """What the twin says about a case. Dense layout: [C, N, ...]."""

    values: dict[str, Tensor]
    tolerances: dict[str, Tensor]
    reach: Tensor  # [C, N], the longer side
    visible: Tensor  # [C, N]


def _run(
    case: Case,
    grads: tuple[Tensor, Tensor],
    unit: float,
    noise: torch.Generator | None = None,
    orders: list[Tensor] | None = None,
    **limits: Any,
) -> tuple[dict[str, Tensor], list[reference.Screen], list[reference.Image]]:
    """The twin, forward and backward; with `noise`, in the order of the run without (equal depths must stay equal)."""

    def shaken(t: Tensor) -> Tensor:
        if noise is None:
            return t
        xi = 2 * torch.rand(t.shape, generator=noise, dtype=torch.float64) - 1
        if t.dim() == 3 and t.shape[-1] == 2:  # conics
            condition = (t[:, 0, 0] * t[:, 1, 1] / torch.linalg.det(t)).detach()
            xi = 0.5 * (xi + xi.mT) + (condition * (2 * torch.rand(len(t), generator=noise) - 1))[:, None, None]
        noisy = t * (1 + 8 * unit * xi)
        if noisy.requires_grad:  # by itself: near the camera what centre and conic pass to the depth cancels
            own = 1 + 8 * unit * (2 * torch.rand(t.shape, generator=noise, dtype=torch.float64) - 1)
            noisy.register_hook(lambda grad: grad * own)
        return noisy

    inputs = [shaken(getattr(case, name).double()).clone().requires_grad_() for name in PARAMETERS]
    options = {**case.options, **limits, "unit": unit, "perturb": shaken, "orders": orders}
    render, alphas, screens, images = reference.rasterization(*inputs, case.Ks, case.width, case.height, **options)
    weight = torch.ones_like(alphas)
    if noise is not None:
        loss_of_t = unit / (1 - alphas.detach()).clamp(min=unit)
        weight = 1 + loss_of_t * (2 * torch.rand(alphas.shape, generator=noise) - 1)
    loss = (render * weight * grads[0]).sum() + (alphas * weight * grads[1]).sum()
    for screen in screens:
        screen.means2d.retain_grad()
    loss.backward()

    c, n = len(screens), len(case.means)
    result = {"render": render, "alphas": alphas}
    result["means2d"] = torch.stack([s.means2d for s in screens])
    result["depths"] = torch.stack([s.depths for s in screens])
    result["conics"] = torch.stack([s.conics for s in screens])[..., [0, 0, 1], [0, 1, 1]]
    for name, tensor in zip(PARAMETERS, inputs, strict=True):
        result["grad_" + name] = torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
    for name in ("grad_means2d", "absgrad"):
        result[name] = torch.zeros(c, n, 2, dtype=torch.float64)
    for camera, image in enumerate(images):
        if image.pixel_means2d.grad is not None:
            per_pixel = image.pixel_means2d.grad
            result["grad_means2d"][camera, image.order] = per_pixel.sum((1, 2))
            result["absgrad"][camera, image.order] = per_pixel.abs().sum((1, 2))
    return {name: t.detach() for name, t in result.items()}, screens, images


def _largest(t: Tensor) -> Tensor:
    return t.abs().amax() if t.numel() else t.sum()


def judge(case: Case, grads: tuple[Tensor, Tensor], unit: float = FLOAT32, **limits: Any) -> Verdict:
    """Values and tolerances of everything a rasterizer computes for a case in an arithmetic of the given rounding unit;
    limits: eps2d, floor and bounds of `reference.project`."""
    values, screens, images = _run(case, grads, unit, **limits)
    noise = torch.Generator().manual_seed(0)
    shaken = [_run(case, grads, unit, noise, [image.order for image in images], **limits)[0] for _ in range(RUNS)]
    tolerances = {}
    for name, value in values.items():
        spread = torch.stack([(other[name] - value).abs() for other in shaken]).amax(0)
        tolerances[name] = 8 * spread + 64 * unit * _largest(value)
    # A round splat's quaternion has gradient 0 as a difference of terms as large as those of its scales.
    terms = _largest(values["grad_scales"] * case.scales) / case.quats.norm(dim=-1).clamp(min=1e-9)[:, None]
    tolerances["grad_quats"] = tolerances["grad_quats"] + 64 * unit * terms

    rounding = torch.stack([image.rounding for image in images])[..., None]
    undecided = torch.stack([image.undecided for image in images])[..., None]
    moves = rounding + torch.where(undecided, torch.stack([image.jump for image in images])[..., None], 0.0)
    tolerances["alphas"] = moves
    mode, alphas = case.options.get("render_mode", "RGB"), values["alphas"]
    depth = torch.stack([_largest(s.depths[s.visible]) for s in screens]).detach()[:, None, None, None]
    # A quotient: each sum's error counts, divided by the smaller sum.
    depth = 2 * depth.expand_as(alphas) / alphas.clamp(min=1e-10)
    color = _largest(case.colors).double()
    if "backgrounds" in case.options:
        color = color + _largest(case.options["backgrounds"])
    channels = [color.expand_as(alphas)] * case.colors.shape[-1] + [depth] * (mode == "RGB+ED")
    tolerances["render"] = moves * torch.cat(channels, -1)
    reach, visible = (torch.stack(rows) for rows in zip(*((s.reach.amax(-1), s.visible) for s in screens), strict=True))
    return Verdict(values, tolerances, reach.detach(), visible)


def assert_agrees(verdict: Verdict, result: dict[str, Tensor], unit: float = FLOAT32) -> None:
    """Check a result of `make_gsplat_fixtures.evaluate` against the twin."""
    visible = verdict.visible
    assert torch.equal(result["radii"] > 0, visible), "visible splats differ"
    # ceil may land on either side only if three sigma is an integer up to 8 roundings of sqrt and eigenvalue, and the
    # loss of a determinant; 64 units bound both for the aspect ratios that occur.
    low, high = ((verdict.reach * (1 + s * 64 * unit)).ceil() for s in (-1, 1))
    radii = result["radii"].double()
    assert ((radii >= low) & (radii <= high))[visible].all(), "radii differ"
    for name, expected in verdict.values.items():
        actual, tolerance = result[name].double(), verdict.tolerances[name]
        if name in ("means2d", "depths", "conics"):
            actual, expected, tolerance = actual[visible], expected[visible], tolerance[visible]
        assert actual.shape == expected.shape, name
        assert torch.isfinite(actual).all(), f"{name} is not finite"
        off = (actual - expected).abs() > tolerance
        assert not off.any(), (name, actual[off], expected[off], tolerance.expand_as(off)[off])
