# SPDX-License-Identifier: Apache-2.0
"""What the guard says when it stops a training: what was met, in which splats, and the likely cause."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nrfgs_ns.appearance.head import base_colors

SHOWN = 3
"""Splats that are described."""
NEAR = 0.1
"""Camera-space depth, scene units, below which a splat counts as on the camera: ten times the near plane."""
HUGE_OF = {"scales": 20.0, "means": 1e6, "quats": math.inf}
"""Sizes (of log-scales, scene units) that no training reaches with learning rates that suit it. A quaternion's length
means nothing."""
HUGE = 1e3
"""The same for all else: logits, what a head stores, the shared weights."""


@dataclass
class Finding:
    """One tensor that condemned a step."""

    name: str
    size: float
    """its largest absolute value: NaN, infinite, or too large"""
    tensor: Tensor


def report(pipeline, step: int, findings: list[Finding], limit: float) -> str:
    """The whole message."""
    model = pipeline.model
    first = findings[0]
    others = ", ".join(finding.name for finding in findings[1:4]) + (", ..." if len(findings) > 4 else "")
    lines = [
        f"Training stopped at step {step}: {first.name} {_what(first, limit)}." + (f" Also: {others}." * bool(others))
    ]
    rows = torch.zeros(0, dtype=torch.int64)
    per_splat = next((f for f in findings if "gauss_params." in f.name), None)
    if per_splat is not None:
        rows = (~(per_splat.tensor.abs() <= limit)).reshape(len(per_splat.tensor), -1).any(1).nonzero().flatten()
        shown = ", ".join(map(str, rows[:SHOWN].tolist())) + (", ..." if len(rows) > SHOWN else "")
        lines.append(f"{per_splat.name}: {len(rows)} of {len(per_splat.tensor)} splats, first {shown}.")
        if len(per_splat.tensor) == model.num_points:
            lines += [describe_splat(model, row) for row in rows[:SHOWN].tolist()]
        else:
            lines.append("Densification has renumbered the splats since.")
    lines.append(f"Likely cause: {_cause(pipeline, findings, rows)}")
    return "\n".join(lines)


def describe_splat(model, row: int) -> str:
    """One splat in numbers: mean, scales (not their logarithms), opacity, base colour, and depth where it was seen."""
    with torch.no_grad():
        parts = {
            "mean": model.means[row],
            "scales": model.scales[row].exp(),
            "quat": model.quats[row],
            "opacity": model.opacities[row].sigmoid(),
            "colour": base_colors(model.features_dc[row]),
        }
        depth = _depth(model, row)
    numbers = ", ".join(f"{name} {_numbers(value)}" for name, value in parts.items())
    return f"  splat {row}: {numbers}" + ("" if depth is None else f", depth {depth:.3g}")


def _numbers(values: Tensor) -> str:
    shown = " ".join(f"{value:.4g}" for value in values.tolist())
    return f"({shown})" if len(values) > 1 else shown


def _what(finding: Finding, limit: float) -> str:
    if math.isnan(finding.size):
        return "has NaN"
    if math.isinf(finding.size):
        return "is infinite"
    return f"reaches {finding.size:.2g}, and Adam cannot square more than {limit:.2g}"


def _depth(model, row: int) -> float | None:
    """Depth of a splat in the camera of the last rendering, scene units; None if that did not see it."""
    info = getattr(model, "info", None)
    if info is None or info.get("gaussian_ids") is None:
        return None
    found = info["depths"][info["gaussian_ids"] == row]
    return float(found[0]) if len(found) else None


def _cause(pipeline, findings: list[Finding], rows: Tensor) -> str:
    """The likeliest reason, and what to do about it."""
    model = pipeline.model
    names = [finding.name for finding in findings]
    broken = [name for name, value in model.named_parameters() if not bool(torch.isfinite(value).all())]
    if broken:
        return (
            f"the parameter {broken[0]} is not finite. It was loaded or edited so, or an update overflowed: go back to "
            "an older checkpoint, and lower its learning rate if it happens again."
        )
    if "loss main_loss" in names and "the rendered image" not in names:
        return (
            f"the rendering is finite and its loss is not, so the image or mask is broken: {_image(pipeline)}. "
            "Replace or remove it."
        )
    for name, value in model.gauss_params.items():
        if value.numel() and float(value.abs().max()) > HUGE_OF.get(name, HUGE):
            return _too_fast(name, float(value.abs().max()))
    for weight in model.head.parameters():
        if float(weight.abs().max()) > HUGE:
            return _too_fast("field", float(weight.abs().max()))
    depths = [depth for row in rows[:SHOWN].tolist() if (depth := _depth(model, row)) is not None]
    if depths and min(depths) < NEAR:
        return (
            f"a splat on the camera, at depth {min(depths):.2g} in image {_image(pipeline)}. Mask what was on the "
            "lens, or remove that image."
        )
    return (
        f"not clear. Image {_image(pipeline)} was being learnt: look at it and at its pose, then lower the learning "
        "rates."
    )


def _too_fast(group: str, size: float) -> str:
    return (
        f"a learning rate that is too high: {group} have reached {size:.2g}. Lower --optimizers.{group}.optimizer.lr "
        "and start from an older checkpoint."
    )


def _image(pipeline) -> str:
    """Name of the image of the last training step."""
    index = getattr(pipeline.model, "watched_image", None)
    names = getattr(getattr(pipeline.datamanager, "train_dataset", None), "image_filenames", None)
    return "of this step" if index is None or names is None else str(names[index])
