# SPDX-License-Identifier: Apache-2.0
"""A finished field trained on for the file: tables that cost less, and the steps on which they lie.

The loss is the training's, of pictures drawn from tables as the file would give them back, plus `rate` for each
byte that a splat is estimated to cost in the mean (`rate.py`). Which splats there are, and which of them are diffuse,
stays.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.reduce import build
from nrfgs_ns.compact.precision import Precision
from nrfgs_ns.compact.rate import Coded, CodedPlaces
from nrfgs_ns.compact.tables import splats_of, steps_of, tables_of
from nrfgs_ns.model.view_noise import ViewNoise

BYTE = 8
"""Bits."""
TOLD = 50
"""Steps between two reports: to ask for a number waits for the GPU."""
NOISY = 0.6
"""Share of the steps in which noise stands for rounding; in the rest, numbers are rounded."""
RATES = {"means": 1.6e-6, "turns": 5e-4, "scales": 2e-3, "opacities": 1e-2, "colors": 7e-4, "latents": 2.5e-3}
"""Learning rates of the tables."""
STEPS_RATE, DENSITY_RATE, FIELD_RATE = 1e-2, 1e-2, 5e-4
LAST = 0.1
"""Of the learning rates, at the end; they fall by a cosine."""


class CodedSplats(nn.Module):
    """The tables of a field (`tables.py`), each with steps that are learnt.

    Args:
        splats: the field's table.
        precision: the steps to begin with.
    """

    def __init__(self, splats: Mapping[str, Tensor], precision: Precision):
        super().__init__()
        values, self.diffuse = tables_of(splats)
        steps = steps_of(values, precision)
        self.tables = nn.ModuleDict()
        for name, table in values.items():
            kind = CodedPlaces if name == "means" else Coded
            self.tables[name] = kind(table.float(), torch.from_numpy(steps[name]).to(table).float())

    def forward(self, rounded: bool) -> tuple[dict[str, Tensor], Tensor]:
        """The field's table as it would come out of a file, and the bits that it costs."""
        coded = {name: table(rounded) for name, table in self.tables.items()}
        bits = sum(self.tables[name].bits(values) for name, values in coded.items())
        return splats_of(coded, self.diffuse), bits


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
        field: the field to begin with, with a neural residual field's head.
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
    for table in coded.tables.values():
        groups += [{"params": [table.log_steps], "lr": STEPS_RATE}, {"params": table.density, "lr": DENSITY_RATE}]
    groups.append({"params": list(head.parameters()), "lr": FIELD_RATE})
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * min(step / steps, 1.0)))
    )
    was_training = model.training
    model.train()
    try:
        for step in range(steps):
            camera, batch = next_view(step)
            splats, bits = coded(rounded=step >= NOISY * steps)
            field = Field(head, splats)
            asked = field._replace(splats=noise.moved(splats, step))
            outputs, _ = model.render(field, camera, asked)
            loss = model.photometric_loss(outputs, batch)
            optimizer.zero_grad(set_to_none=True)
            (loss + rate / (BYTE * count) * bits).backward()
            optimizer.step()
            schedule.step()
            if step % TOLD == 0:
                on_step(step, float(bits.detach()))
    finally:
        model.train(was_training)
    with torch.no_grad():
        splats, _ = coded(rounded=True)
    steps = {name: table.steps.detach().cpu().double().numpy() for name, table in coded.tables.items()}
    return Tuned(Field(head.requires_grad_(False).eval(), splats), steps)
