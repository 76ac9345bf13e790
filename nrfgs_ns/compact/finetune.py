# SPDX-License-Identifier: Apache-2.0
"""A finished field trained on for the file: tables that cost less, and the steps on which they lie.

The loss is the training's, of pictures drawn from tables as the file would give them back, plus `rate` for each
byte that a splat is estimated to cost in the mean (`rate.py`). Which splats are diffuse stays. A few times, splats go
whose bytes cost more than the pictures would lose without them (`without_them`).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.field import Field, Sight
from nrfgs_ns.appearance.head import SplatAppearance
from nrfgs_ns.appearance.reduce import build, latent_basis, with_components, with_rank
from nrfgs_ns.compact.quantise import MOST_BITS, Grid, morton
from nrfgs_ns.compact.rate import Density, Rounded, bits_of_places
from nrfgs_ns.compact.tables import COLUMNS, Precision, splats_of, steps_of, tables_of
from nrfgs_ns.model.view_noise import ViewNoise

BYTE = 8
"""Bits."""
EVERY = 4
"""Steps of which one counts bits, for all of them: it takes longer than a picture."""
REPORT_EVERY = 20 * EVERY
"""Steps between two reports: reading a number waits for the GPU."""
NOISY = 0.3
"""Share of the steps in which noise stands for rounding; in the rest, numbers are rounded."""
RATES = {"means": 1.6e-6, "turns": 5e-4, "scales": 2e-3, "opacities": 1e-2, "colors": 7e-4, "latents": 4e-3}
"""Learning rates of the tables; the means' in scene units, the latents' in standard deviations of the strongest."""
STEPS_RATE, DENSITY_RATE, FIELD_RATE = 3e-2, 2e-2, 5e-4
PRUNINGS = (0.08, 0.16, 0.24, 0.32)
"""When splats are removed, in shares of the steps. Each time every fourth in the file's order is a candidate:
neighbours, which hide behind each other, must not go together."""
WORTH = 1.0
"""Weight of a splat's bytes against the growth of the loss without it."""
LAST = 0.03
"""Final share of the learning rates, which fall by a cosine."""


def prepared(field: Field, weight: Tensor) -> Field:
    """The field at the start of a fine-tune: its latents are their own principal components, weighted by the splats'
    contributions to the training views, weight [N] >= 0."""
    return with_rank(field, latent_basis(field, weight), field.head.config.latent_dim)


class CodedSplats(nn.Module):
    """The tables of a field (`tables.py`), each with learnable steps that begin with those of `precision`."""

    def __init__(self, splats: Mapping[str, Tensor], precision: Precision):
        super().__init__()
        values, diffuse = tables_of(splats)
        steps = steps_of(values, precision)
        grid = Grid(values["means"].amin(dim=0).cpu().numpy(), steps["means"])
        codes = grid.codes(values["means"].cpu().numpy()).clip(max=2**MOST_BITS - 1)
        order = torch.from_numpy(np.argsort(morton(codes), kind="stable")).to(diffuse.device)  # as in a file
        values["latents"] = values["latents"][(~diffuse).cumsum(0)[order[~diffuse[order]]] - 1]
        values |= {name: values[name][order] for name in ("means", *COLUMNS)}
        self.diffuse = diffuse[order]
        self.tables = nn.ModuleDict(
            {
                name: Rounded(table.float(), torch.from_numpy(steps[name]).to(table).float())
                for name, table in values.items()
            }
        )
        self.density = Density(self._row({name: table.float() for name, table in values.items()}))
        self.density_of_latents = Density(values["latents"].float())

    def forward(self, rounded: bool) -> dict[str, Tensor]:
        """The tables as read back from a file."""
        return {name: table(rounded) for name, table in self.tables.items()}

    def splats(self, tables: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return splats_of(tables, self.diffuse)

    def bits(self, tables: Mapping[str, Tensor]) -> Tensor:
        """Bits of each splat in tables as `forward` gives them, [N]."""
        steps = {name: table.steps for name, table in self.tables.items()}
        bits = bits_of_places(tables["means"], steps["means"]) + self.density.bits(self._row(tables), self._row(steps))
        latents = self.density_of_latents.bits(tables["latents"], steps["latents"])
        return bits.index_add(0, (~self.diffuse).nonzero()[:, 0], latents)

    @torch.no_grad()
    def keep(self, kept: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Keep the splats `kept`, bool [N], and their optimizer state."""
        of_latents, self.diffuse = kept[~self.diffuse], self.diffuse[kept]
        for group, (name, table) in zip(optimizer.param_groups, self.tables.items(), strict=False):
            rows, old = of_latents if name == "latents" else kept, table.values
            state = {
                key: value[rows] if value.shape == old.shape else value
                for key, value in optimizer.state.pop(old, {}).items()
            }
            table.values = nn.Parameter(old[rows])
            optimizer.state[table.values], group["params"] = state, [table.values]

    @staticmethod
    def _row(tables: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([tables[name] for name in COLUMNS], dim=-1)


class Gated(NamedTuple):
    """A field whose rendered opacities are multiplied."""

    field: Field
    gates: Tensor
    """[N]"""

    def seen_from(self, view: Sight) -> SplatAppearance:
        appearance = self.field.seen_from(view)
        return appearance._replace(opacities=appearance.opacities * self.gates[view.visible])


def without_them(model, field: Field, views: Iterable[tuple[Any, dict[str, Any]]]) -> tuple[Tensor, float]:
    """Growth of the training views' squared error without each splat, the others as they are.

    A pixel is linear in the opacity of each splat alone: taking splat i away takes d_p = dI_p / dg_i from each pixel p,
    where g_i = 1 multiplies its opacity, and the squared error grows by

        sum_p |d_p|^2 - 2 (I_p - truth_p) d_p.

    The second sum is the error's gradient by g_i. The first is the mean of (d sum_p s_p I_p / dg_i)^2 over signs s_p
    drawn at random (Hutchinson's estimator), one drawing for each view.

    Args:
        model: in training mode.
        views: training cameras and their photographs.

    Returns:
        the growth as a share of the squared error [N], and the mean of the training's loss.
    """
    count, device = len(field.splats["means"]), field.splats["means"].device
    growth, error, loss = (torch.zeros(n, device=device) for n in (count, 1, 1))
    for number, (camera, batch) in enumerate(views, 1):
        gates = torch.ones(count, device=device, requires_grad=True)
        outputs, _ = model.render(field, camera, Gated(field, gates))
        off = outputs["rgb"] - model.truth_of(batch, outputs["background"])
        if (mask := model.mask_of(batch)) is not None:
            off = off * mask
        squared = off.square().sum()
        signs = torch.empty_like(off).bernoulli_().mul_(2.0).sub_(1.0)
        (of_error,) = torch.autograd.grad(squared, gates, retain_graph=True)
        (of_signs,) = torch.autograd.grad((off * signs).sum(), gates)
        growth += of_signs.square() - of_error
        error += squared.detach()
        loss += (model.photometric_loss(outputs, batch).detach() - loss) / number
    return growth / error, float(loss)


@dataclass
class Tuned:
    """A field that was trained for the file."""

    field: Field
    steps: dict[str, np.ndarray]
    """of each of the file's tables, one for each column; the field's numbers lie on them"""


def fine_tune(
    model,
    field: Field,
    next_view: Callable[[int], tuple[Any, dict[str, Any]]],
    noise: ViewNoise,
    views: int,
    steps: int,
    rate: float,
    precision: Precision,
    on_step: Callable[[int, float], None] = lambda *_: None,
) -> Tuned:
    """Fine-tune a field for its size in a file.

    Args:
        model: renders the field; its own splats stay as they are.
        field: the field to begin with (`prepared`), with a neural residual field's head.
        next_view: step -> a training camera and its photograph.
        noise: moves the head's camera centres.
        views: number of training views on which splats are weighed.
        rate: loss for a byte of each splat.
        precision: the first steps of the grids.
        on_step: called with the step and the bits, every REPORT_EVERY steps.
    """
    head = build(field.head.config, field.head.state_dict(), field.head.scene_unit).requires_grad_(True).train()
    coded, count = CodedSplats(field.splats, precision), len(field.splats["means"])
    groups = [{"params": [table.values], "lr": RATES[name]} for name, table in coded.tables.items()]
    groups[0]["lr"] *= model.scene_unit
    if len(latents := coded.tables["latents"].values) > 1:
        groups[-1]["lr"] *= float(latents.detach().std(dim=0, correction=0).max())
    densities = [*coded.density.parameters(), *coded.density_of_latents.parameters()]
    groups += [
        {"params": [table.log_steps for table in coded.tables.values()], "lr": STEPS_RATE},
        {"params": densities, "lr": DENSITY_RATE},
        {"params": list(head.parameters()), "lr": FIELD_RATE},
    ]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * min(step / steps, 1.0)))
    )
    prunings = [round(share * steps) for share in PRUNINGS]
    turns = torch.arange(count, device=coded.diffuse.device) % max(len(prunings), 1)
    was_training = model.training
    model.train()
    try:
        for step in range(steps):
            if step in prunings:
                with torch.no_grad():
                    tables = coded(rounded=True)
                    cost = coded.bits(tables) * (WORTH * rate / (BYTE * count))
                growth, loss = without_them(model, Field(head, coded.splats(tables)), map(next_view, range(views)))
                # The training's loss is about the root of the squared error.
                kept = (turns != prunings.index(step)) | (0.5 * loss * growth > cost)
                coded.keep(kept, optimizer)
                turns = turns[kept]
            camera, batch = next_view(step)
            tables = coded(rounded=step >= NOISY * steps)
            splats = coded.splats(tables)
            field = Field(head, splats)
            perturbed = field._replace(splats=noise.moved(splats, step))
            outputs, _ = model.render(field, camera, perturbed)
            loss = model.photometric_loss(outputs, batch)
            if step % EVERY == 0:
                bits = coded.bits(tables)
                loss = loss + EVERY * rate / (BYTE * count) * bits.sum()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
            if step % REPORT_EVERY == 0:
                on_step(step, float(bits.detach().sum()))
    finally:
        model.train(was_training)
    with torch.no_grad():
        splats = coded.splats(coded(rounded=True))
    steps = {name: table.steps.detach().cpu().double().numpy() for name, table in coded.tables.items()}
    field = Field(head.requires_grad_(False).eval(), splats)
    used = (splats["latents"] != 0).any(dim=0).nonzero()[:, 0]
    if 0 < len(used) < splats["latents"].shape[1]:
        field, steps["latents"] = with_components(field, used), steps["latents"][used.cpu().numpy()]
    return Tuned(field, steps)
