# SPDX-License-Identifier: Apache-2.0
"""`nrfgs inspect`: loss and savings without parts of a trained field, on test views.

Nothing is retrained: the loss is at least that of a model trained without the part.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Column, Table
from torch.utils.benchmark import Timer

from nrfgs_lab.training_run import machine
from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NeuralResidualField
from nrfgs_ns.appearance.reduce import LatentBasis, branches, latent_basis, rebuilt, with_rank
from nrfgs_ns.compact.finetune import contributions_to
from nrfgs_ns.data.views import evenly_spaced
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, write_whole
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model.harmonics_fit import look_through
from nrfgs_ns.progress import progress
from nrfgs_ns.trained.command import NamesTraining
from nrfgs_ns.trained.loading import load_model

TIMED = 5
"""Evaluations of a view's head; the fastest counts, because other work on the machine only adds."""


@dataclass
class Inspect(NamesTraining):
    """Measure what each part of a trained field is worth, and what it costs."""

    output: Path | None = None
    """file for the numbers; None: inspect.json beside the config"""
    views: int = 12
    """test views to measure on, evenly spaced"""
    budget: float = 0.05
    """dB that the parts may cost together that are left out at once"""

    def main(self) -> None:
        config = self.config()
        output = self.output or config.parent / "inspect.json"
        check_writable(output, "--output")
        if not self.budget >= 0:
            raise InputError(f"--budget is {self.budget}; it must be zero or positive.")
        pipeline = load_model(config, "test", measured=True)
        model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
        if not isinstance(model.head, NeuralResidualField):
            raise InputError(f"{config}: the {model.head.name!r} head has no parts. Name a training of nrfgs.")
        pairs = pipeline.datamanager.fixed_indices_eval_dataloader
        images = [pair for pair in pairs if (mask := model.mask_of(pair[1])) is None or mask.any()]
        if not len(images) or self.views < 1:
            fix = "Give --views 1 or more, and masks that leave something."
            raise InputError(f"{config}: {self.views} of {len(images)} test views inside masks. {fix}")
        images = [images[i] for i in evenly_spaced(len(images), self.views)]
        with progress(f"Looking at the splats from {len(cameras)} training views"):
            basis = latent_basis(model.field, contributions_to(model, cameras))
            distance = mean_log_distance(model, cameras)
        field, views = model.field.detached(), FieldViews(model, images)
        candidates = list(changes(field, basis, distance))
        rows = [row("nothing", "full", field, views, None)]
        with progress("Leaving out", len(candidates)) as advance:
            for name, group, change in candidates:
                rows.append(row(name, group, change(field), views, rows[0].psnr))
                advance(name)
        all_together, left_out = together(field, rows, candidates, basis, views, self.budget)
        result = {
            "machine": machine(),
            "splats": model.num_points,
            "views": len(images),
            "budget_db": self.budget,
            "rows": [asdict(entry) for entry in rows],
            "together": {**asdict(all_together), "left_out": left_out},
        }
        write_whole(output, json.dumps(result, indent=1) + "\n")
        CONSOLE.print(table([*rows, all_together]))
        parts = ", ".join(left_out) or "nothing"
        CONSOLE.print(f"Within {self.budget:g} dB can be left out together: {parts}. Numbers: {output}", soft_wrap=True)


@dataclass
class Row:
    """One field, measured."""

    part: str  # the part left out
    group: str  # full, part, rank, together
    psnr: float  # mean over the views, dB
    loss_db: float  # the full field's PSNR minus this one's
    bytes: int  # of splats and head, float32
    head_seconds: float  # mean over the views


Candidate = tuple[str, str, Callable[[Field], Field]]
"""Name, group, and the change."""


def changes(field: Field, basis: LatentBasis, distance: float) -> Iterator[Candidate]:
    """Parts that can be left out of a field."""
    config = field.head.config
    if field.head.high is not None:
        yield "high branch", "part", without_high_branch
    yield "low branch", "part", without_low_branch
    if config.opacity_residual:
        yield "opacity residual", "part", without_opacity_residual
    if config.use_distance:
        yield "distance", "part", partial(with_constant_distance, log_distance=distance)
    ranks = range(1, config.latent_dim + 1)
    for rank in (rank for rank in ranks if rank <= 8 or rank % 8 == 0):
        yield f"latent rank {rank}", "rank", partial(with_rank, basis=basis, rank=rank)


class FieldViews:
    """Views, each a camera and its batch, projected once: no change moves a splat. The model is in evaluation mode."""

    def __init__(self, model, views: list):
        self.model, self.views = model, []
        for camera, batch in views:
            with torch.no_grad():
                view = model.project(camera.to(model.device))
            truth = model.truth_of(batch, model.background_color.to(model.device))
            self.views.append((view, truth, model.mask_of(batch)))

    @torch.no_grad()
    def psnr(self, field: Field) -> float:
        """Mean over the views, inside masks, dB."""
        pictures = (self.model.composite(view, field.seen_from(view))[0]["rgb"] for view, _, _ in self.views)
        return fmean(psnr(rgb, truth, mask) for rgb, (_, truth, mask) in zip(pictures, self.views, strict=True))

    @torch.no_grad()
    def head_seconds(self, field: Field) -> float:
        """Mean of the head's time over the views."""
        timers = [Timer("field.seen_from(view)", globals={"field": field, "view": view}) for view, _, _ in self.views]
        return fmean(min(timer.timeit(1).mean for _ in range(TIMED)) for timer in timers)


def row(part: str, group: str, field: Field, views: FieldViews, full: float | None) -> Row:
    """Measure one field; `full` is the full field's PSNR, None for the full field."""
    score = views.psnr(field)
    size = sum(value.nbytes for value in (*field.head.parameters(), *field.splats.values()))
    return Row(part, group, score, 0.0 if full is None else full - score, size, views.head_seconds(field))


def together(
    field: Field, rows: list[Row], candidates: list[Candidate], basis: LatentBasis, views: FieldViews, budget: float
) -> tuple[Row, list[str]]:
    """Smallest field within `budget` dB, by leaving out the cheapest parts first, and the names of what it lacks.

    Parts may take half of the budget; the latents' rank the rest. The low branch stays: it has the opacity, and without
    its colours nothing is saved.
    """
    full = rows[0].psnr
    change_of = {name: change for name, _, change in candidates}
    left_out: list[str] = []
    for part in sorted((r for r in rows if r.group == "part"), key=lambda r: r.loss_db):
        if part.part != "low branch" and part.loss_db <= budget:
            smaller = change_of[part.part](field)
            if full - views.psnr(smaller) <= 0.5 * budget:
                field = smaller
                left_out.append(part.part)
    low, rank = 1, field.head.config.latent_dim
    while low < rank:  # the loss falls with the rank, except for rounding: halve the interval
        middle = (low + rank) // 2
        enough = full - views.psnr(with_rank(field, basis, middle)) <= budget
        low, rank = (low, middle) if enough else (middle + 1, rank)
    if rank < field.head.config.latent_dim:
        field = with_rank(field, basis, rank)
        left_out.append(f"latents beyond rank {rank}")
    return row("together", "together", field, views, full), left_out


@torch.no_grad()
def mean_log_distance(model, cameras) -> float:
    """Mean of log r over the training views, weighted by contribution; r in scene units, as the field sees it."""
    total, weight = 0.0, 0.0
    for index in range(len(cameras)):
        view, _, share = look_through(model, cameras[index : index + 1])
        towards = view.center - model.field.splats["means"].index_select(0, view.visible)
        distance = (towards.norm(dim=-1) / model.head.scene_unit).clamp_min(1e-10)
        share = share.clamp_min(0.0).double()
        total, weight = total + float((share * distance.log()).sum()), weight + float(share.sum())
    return total / max(weight, 1e-30)


def table(rows: list[Row]) -> Table:
    """Table of the rows, a section for each group."""
    columns = (Column(name, justify="right") for name in ("PSNR (dB)", "loss (dB)", "MB", "head (ms)"))
    printed = Table("left out", *columns)
    for entry, following in zip(rows, [*rows[1:], None], strict=True):
        numbers = f"{entry.psnr:.2f}", f"{entry.loss_db:.3f}", f"{entry.bytes / 1e6:.2f}"
        last = following is not None and following.group != entry.group
        printed.add_row(entry.part, *numbers, f"{1e3 * entry.head_seconds:.1f}", end_section=last)
    return printed


def without_high_branch(field: Field) -> Field:
    """The low branch alone, as with a shut gate."""
    low = {name: value for name, value in field.head.state_dict().items() if name.startswith("low.")}
    return rebuilt(field, low, num_bands=1)


def without_low_branch(field: Field) -> Field:
    """The low branch's colours are 0; its opacity residual stays."""
    weights = dict(field.head.state_dict())
    for name in ("low.2.weight", "low.2.bias"):
        weights[name] = torch.cat([torch.zeros_like(weights[name][:3]), weights[name][3:]])
    return rebuilt(field, weights)


def without_opacity_residual(field: Field) -> Field:
    """Base opacities."""
    weights = dict(field.head.state_dict())
    weights |= {name: weights[name][:3] for name in ("low.2.weight", "low.2.bias")}
    return rebuilt(field, weights, opacity_residual=False)


def with_constant_distance(field: Field, log_distance: float) -> Field:
    """A constant log distance, folded into the biases."""
    weights = dict(field.head.state_dict())
    column = field.head.config.latent_dim + 3  # behind latents and base colour
    for branch in branches(weights):
        first = weights[f"{branch}.0.weight"]
        weights[f"{branch}.0.weight"] = torch.cat([first[:, :column], first[:, column + 1 :]], dim=1)
        weights[f"{branch}.0.bias"] = weights[f"{branch}.0.bias"] + log_distance * first[:, column]
    return rebuilt(field, weights, use_distance=False)
