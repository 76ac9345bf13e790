# SPDX-License-Identifier: Apache-2.0
"""Leave parts of a trained field out, and measure on held-out views what that costs and saves.

Nothing is trained again: a number here says what the trained model makes of a part, which is at least what a model
trained without it would lose by being without.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from nrfgs_ns.appearance.diffuse import DIFFUSE
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.reduce import (
    LatentBasis,
    input_columns,
    latent_basis,
    with_constant_distance,
    with_rank,
    without_high_branch,
    without_input,
    without_low_branch,
    without_opacity_residual,
)
from nrfgs_ns.simplify.field_views import THRESHOLDS, FieldViews, dropped, slim
from nrfgs_ns.simplify.residuals import Residuals


@dataclass
class Row:
    """One field, measured."""

    part: str
    """what was left out"""
    group: str
    """full, part, input, rank, residual, together"""
    psnr: float
    """mean over the views, dB"""
    loss_db: float
    """what it lacks of the full field"""
    bytes: int
    """of the splats and the head, float32"""
    head_seconds: float
    """for one view, mean over the views"""
    diffuse: float = 0.0
    """share of the splats without residual"""
    rank: int | None = None
    """numbers in a latent, where that is what was changed"""
    threshold: float | None = None
    """8-bit steps, where residuals below it were dropped"""


Change = Callable[[Field], Field]


def changes(field: Field, seen: Residuals, basis: LatentBasis) -> Iterator[tuple[str, str, dict[str, Any], Change]]:
    """All that can be left out of a field: name, group, the row's extra columns, and what does it."""
    config = field.head.config
    if field.head.high is not None:
        yield "high branch", "part", {}, without_high_branch
    yield "low branch", "part", {}, without_low_branch
    if config.opacity_residual:
        yield "opacity residual", "part", {}, without_opacity_residual
    if config.use_distance:
        yield "distance", "part", {}, lambda field: with_constant_distance(field, seen.mean_log_distance)
    inputs = {**input_columns(config, "low"), **(input_columns(config, "high") if field.head.high is not None else {})}
    for name in inputs:
        if name == "direction" or name.startswith("band"):
            yield name, "input", {}, lambda field, name=name: without_input(field, name)
    for rank in range(1, config.latent_dim + 1):
        yield f"latent rank {rank}", "rank", {"rank": rank}, lambda field, rank=rank: with_rank(field, basis, rank)
    for threshold in THRESHOLDS:
        what = "all residuals" if threshold == float("inf") else f"residuals below {threshold:g} steps"
        yield (
            what,
            "residual",
            {"threshold": threshold},
            lambda field, threshold=threshold: dropped(field, seen, threshold),
        )


def row(part: str, group: str, field: Field, views: FieldViews, full: float | None, **extra: Any) -> Row:
    """Measure one field; `full` is the full field's PSNR, None for itself."""
    score = views.psnr(field)
    return Row(
        part,
        group,
        score,
        (score if full is None else full) - score,
        field.bytes,
        views.head_seconds(field),
        diffuse_splats(field) / max(len(field.splats["means"]), 1),
        **extra,
    )


def diffuse_splats(field: Field) -> int:
    """How many splats of a field have no residual."""
    return int(field.splats[DIFFUSE].sum()) if DIFFUSE in field.splats else 0


def together(
    field: Field, rows: list[Row], seen: Residuals, views: FieldViews, budget: float, on_trial: Callable[[str], None]
) -> tuple[Row, list[str]]:
    """All that can be left out at once within `budget` dB, found by trying the cheapest first.

    Parts may take half of the budget between them; residuals and the latents' rank what is left (`slim`). The low
    branch stays, for opacity's sake: without its colours nothing is saved.

    Returns:
        the row of the smallest field that was found, and what was left out.
    """
    full, whole = rows[0].psnr, field
    makers = {name: make for name, _, _, make in changes(field, seen, latent_basis(field, seen.weight))}
    left_out: list[str] = []
    for candidate in sorted((r for r in rows if r.group == "part"), key=lambda r: r.loss_db):
        if candidate.part == "low branch" or candidate.loss_db > budget:
            continue
        on_trial(candidate.part)
        smaller = makers[candidate.part](field)
        if full - views.psnr(smaller) <= 0.5 * budget:
            field = smaller
            left_out.append(candidate.part)
    slimmed = slim(field, seen, views, full - budget, on_trial=on_trial)
    if diffuse_splats(slimmed.field) > diffuse_splats(field):
        every = slimmed.threshold == float("inf")
        left_out.append("all residuals" if every else f"residuals below {slimmed.threshold:g} steps")
    if slimmed.rank < whole.head.config.latent_dim and slimmed.threshold != float("inf"):
        left_out.append(f"latents beyond rank {slimmed.rank}")
    return row("together", "together", slimmed.field, views, full, rank=slimmed.rank), left_out
