# SPDX-License-Identifier: Apache-2.0
"""A finished field trained on for the file: tables that cost less, and the steps on which they lie.

The loss is the training's, of pictures drawn from tables as the file would give them back, plus `rate` for each
byte that a splat is estimated to cost in the mean (`rate.py`). Which splats there are, and which of them are diffuse,
stays. Before that, splats go whose bytes are worth more than the light that they bring (`prepared`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.reduce import build, latent_basis, with_components, with_rank
from nrfgs_ns.compact.precision import Precision
from nrfgs_ns.compact.quantise import MOST_BITS, Grid, morton
from nrfgs_ns.compact.rate import Density, Rounded, bits_of_places
from nrfgs_ns.compact.tables import COLUMNS, splats_of, steps_of, tables_of
from nrfgs_ns.model.view_noise import ViewNoise

BYTE = 8
"""Bits."""
EVERY = 4
"""Steps of which one counts bits, for all of them: it takes longer than a picture."""
TOLD = 20 * EVERY
"""Steps between two reports: to ask for a number waits for the GPU."""
NOISY = 0.3
"""Share of the steps in which noise stands for rounding; in the rest, numbers are rounded."""
RATES = {"means": 1.6e-6, "turns": 5e-4, "scales": 2e-3, "opacities": 1e-2, "colors": 7e-4, "latents": 4e-3}
"""Learning rates of the tables; the means' in scene units, the latents' in standard deviations of the strongest."""
STEPS_RATE, DENSITY_RATE, FIELD_RATE = 3e-2, 2e-2, 5e-4
DEAREST = 100.0
"""Bytes of a splat, about twenty, over how much the loss grows where its light is missing, about a fifth. A splat that
brings less than this, times the rate, of the mean splat's light is not worth its bytes."""
LAST = 0.03
"""Of the learning rates, at the end; they fall by a cosine."""


def prepared(field: Field, weight: Tensor, rate: float) -> Field:
    """A field as a fine-tune begins with it: without splats that are not worth their bytes, and with latents that are
    their own principal components, so that those that matter little can go.

    Args:
        weight: what each splat contributes to the training views' pixels, >= 0. [N]
        rate: as for `fine_tune`.
    """
    kept = (weight >= rate * DEAREST * weight.mean()).nonzero()[:, 0]
    field = Field(field.head, {name: value[kept] for name, value in field.splats.items()})
    return with_rank(field, latent_basis(field, weight[kept]), field.head.config.latent_dim)


class CodedSplats(nn.Module):
    """The tables of a field (`tables.py`), each with steps that are learnt.

    Args:
        splats: the field's table.
        precision: the steps to begin with.
    """

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
        """The file's tables as they would come out of it."""
        return {name: table(rounded) for name, table in self.tables.items()}

    def splats(self, tables: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The field's table of the file's."""
        return splats_of(tables, self.diffuse)

    def bits(self, tables: Mapping[str, Tensor]) -> Tensor:
        """What tables, as `forward` gives them, cost: a scalar."""
        steps = {name: table.steps for name, table in self.tables.items()}
        return (
            bits_of_places(tables["means"], steps["means"])
            + self.density.bits(self._row(tables), self._row(steps))
            + self.density_of_latents.bits(tables["latents"], steps["latents"])
        )

    @staticmethod
    def _row(tables: Mapping[str, Tensor]) -> Tensor:
        """The columns of all splats beside their means, in the file's order."""
        return torch.cat([tables[name] for name in COLUMNS], dim=-1)


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
    steps: int,
    rate: float,
    precision: Precision,
    on_step: Callable[[int, float], None] = lambda *_: None,
) -> Tuned:
    """Train a field on for what it costs in a file.

    Args:
        model: an NrfgsModel, which says how a field is drawn; its own splats are left alone.
        field: the field to begin with (`prepared`), with a neural residual field's head.
        next_view: a training camera and its photograph for each step.
        noise: on where the head is asked from.
        steps: how many.
        rate: of the loss, for a byte of each splat.
        precision: the steps of the grids to begin with.
        on_step: told the step and the bits, now and then.
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
    was_training = model.training
    model.train()
    try:
        for step in range(steps):
            camera, batch = next_view(step)
            tables = coded(rounded=step >= NOISY * steps)
            splats = coded.splats(tables)
            field = Field(head, splats)
            asked = field._replace(splats=noise.moved(splats, step))
            outputs, _ = model.render(field, camera, asked)
            loss = model.photometric_loss(outputs, batch)
            if step % EVERY == 0:
                bits = coded.bits(tables)
                loss = loss + EVERY * rate / (BYTE * count) * bits
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
            if step % TOLD == 0:
                on_step(step, float(bits.detach()))
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
