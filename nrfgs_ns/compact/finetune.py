# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning of a finished field for its file: tables that cost less, and learnt steps of their grids.

The loss is the training's, of images rendered from tables as the file would give them back, plus `rate` for each byte
that a splat is estimated to cost on average. For a given size the rate is adapted while it trains: it grows where the
tables are estimated too large, and falls where there is room. A few times, splats are removed whose bytes cost more
than images lose without them (`growth_without`).

A column of a table lies on a uniform grid, value = step * integer, with a step that is learnt. In training, rounding is
imitated by noise that is uniform over a step (Balle et al., arXiv 1611.01704), or done, with the gradient of the
identity. A number x then costs bits,

    -log2 P(x),    P(x) = sum_k w_k (F((x + step/2 - m - m_k) / b_k) - F((x - step/2 - m - m_k) / b_k)),

F the logistic function: a mixture of two for each column, about a mean m that is linear in the two rows before and in
the row's earlier columns; its widths b_k grow with the neighbours' distances from their means. A file's coder
(`entropy.py`) predicts from the same neighbours, but nothing of this is in a file.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from nrfgs_ns.appearance.head import Field, ViewNoise
from nrfgs_ns.appearance.reduce import latent_basis, with_components, with_rank
from nrfgs_ns.compact.encode import drawable
from nrfgs_ns.compact.tables import COLUMNS, MOST_BITS, Grid, morton, splats_of, steps_of, tables_of
from nrfgs_ns.data.views import camera_spacing
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.harmonics_fit import look_through
from nrfgs_ns.model.loss import photometric

EVERY = 4
"""Steps between two counts of the bits, which take longer than an image."""
REPORT_EVERY = 20 * EVERY
"""Steps between two reports: reading a number waits for the GPU."""
NOISY = 0.3
"""Share of the steps with noise instead of rounding."""
RATES = {"means": 1.6e-6, "turns": 5e-4, "scales": 2e-3, "opacities": 1e-2, "colors": 7e-4, "latents": 4e-3}
"""Learning rates of the tables; means: in scene units; latents: in standard deviations of the strongest component."""
STEPS_RATE, DENSITY_RATE, FIELD_RATE = 3e-2, 2e-2, 5e-4
PRUNINGS = (0.08, 0.16, 0.24, 0.32)
"""When splats are removed, in shares of the steps. Each time every fourth in the file's order is a candidate, because
neighbours, which hide behind each other, must not be removed together."""
WORTH = 1.0
"""Weight of a splat's bytes against the growth of the loss without it."""
RATES_FOR_SIZE = (1e-7, 0.1)
"""Smallest and largest rate that is tried for a size."""
HASTE = 30.0
"""Speed at which a rate is adapted to a size: over the steps, its logarithm moves by so much times the size's error (as
a logarithm). A size is about the cube root of one over the rate, so that a tenth of the steps takes back two thirds."""
HASTIEST = 0.2
"""Largest change of the rate's logarithm in a count of the bits, for the same error."""
LAST = 0.03
"""Final share of the learning rates, which fall by a cosine."""
WIDTHS = (-2.0, -0.3)
"""Logarithms of the logistics' initial widths, in standard deviations of the column."""
SEEN = 0.3
"""Added to the neighbours' errors, in usual widths."""
NARROWEST = 0.05
"""Width of the narrowest logistic, in steps: narrower ones cost no less."""


class Rounded(nn.Module):
    """A table with learnable values [N, C] and steps [C] > 0."""

    def __init__(self, values: Tensor, steps: Tensor):
        super().__init__()
        self.values = nn.Parameter(values.clone())
        self.log_steps = nn.Parameter(steps.log())

    @property
    def steps(self) -> Tensor:
        return self.log_steps.exp()

    def forward(self, rounded: bool) -> Tensor:
        """The table as a file would give it back: rounded, or with noise instead. [N, C]"""
        steps = self.steps
        places = (self.values / steps).detach()
        off = places.round() - places if rounded else torch.rand_like(places) - 0.5
        return self.values + steps * off


class Density(nn.Module):
    """The distribution of a table's columns given their neighbours; `values` [N, C] start it."""

    def __init__(self, values: Tensor):
        super().__init__()
        columns = values.shape[1]
        spread, mean = values.std(dim=0, correction=0), values.mean(dim=0)
        widths = spread.clamp_min(1e-6).log()[:, None] + values.new_tensor(WIDTHS)
        self.centers = nn.Parameter(mean[:, None].repeat(1, len(WIDTHS)))
        self.log_widths = nn.Parameter(widths)
        self.log_shares = nn.Parameter(torch.zeros_like(widths))
        self.of_left = nn.Parameter(values.new_zeros(columns, columns))
        self.of_left_before = nn.Parameter(values.new_zeros(columns, columns))
        self.of_before = nn.Parameter(values.new_zeros(2, columns))
        self.activity = nn.Parameter(values.new_zeros(4, columns))
        self.growth = nn.Parameter(values.new_zeros(columns))

    def bits(self, values: Tensor, steps: Tensor) -> Tensor:
        """Bits of each row of values [N, C] rounded to steps [C], [N]."""
        before, before_2 = _earlier(values, 1), _earlier(values, 2)
        mean = values @ self.of_left.tril(-1).T + before @ self.of_left_before.tril(-1).T
        residuals = values - (mean + self.of_before[0] * before + self.of_before[1] * before_2)

        # The neighbours' errors in usual widths, as constants.
        usual = self.log_widths.detach().mean(dim=-1).exp().maximum(steps.detach())
        off = residuals.detach().abs() / usual
        left, left_2 = (nn.functional.pad(off, (k, 0))[:, : off.shape[1]] for k in (1, 2))
        shares = self.activity.softmax(dim=0)
        seen = shares[0] * _earlier(off, 1) + shares[1] * _earlier(off, 2) + shares[2] * left + shares[3] * left_2
        grown = (self.growth * torch.log(seen + SEEN))[..., None]

        steps = steps[:, None]
        widths = (self.log_widths + grown).exp().maximum(NARROWEST * steps.detach())
        from_center = residuals[..., None] - self.centers
        upper, lower = (from_center + 0.5 * steps) / widths, (from_center - 0.5 * steps) / widths
        # F(a) - F(b) = F(a) F(-b) (1 - exp(b - a)), which does not vanish in the tails.
        inside = logsigmoid(upper) + logsigmoid(-lower) + torch.log(-torch.expm1(-steps / widths))
        return -torch.logsumexp(inside + self.log_shares.log_softmax(dim=-1), dim=-1).sum(dim=-1) / math.log(2.0)


def _earlier(values: Tensor, count: int) -> Tensor:
    """Rows [N, C] `count` rows later; the first ones are 0."""
    return nn.functional.pad(values, (0, 0, count, 0))[: len(values)]


def bits_of_places(means: Tensor, steps: Tensor) -> Tensor:
    """Bits of one of N means [N, 3]: the choice of a cell of size `steps` [3] in their box, in any order."""
    extent = (means.detach().amax(dim=0) - means.detach().amin(dim=0)).clamp_min(1e-30)
    cells = (extent.log() - steps.log()).clamp_min(0.0).sum() / math.log(2.0)
    return (cells - math.log2(max(len(means), 1)) + 1.0 / math.log(2.0)).clamp_min(0.0)


class CodedSplats(nn.Module):
    """The tables of a field (`tables.py`) in the order of a file, each with learnable steps."""

    def __init__(self, splats: Mapping[str, Tensor]):
        super().__init__()
        values = tables_of(splats)
        steps = steps_of(values)
        grid = Grid(values["means"].amin(dim=0).cpu().numpy(), steps["means"])
        codes = grid.codes(values["means"].cpu().numpy()).clip(max=2**MOST_BITS - 1)
        order = torch.from_numpy(np.argsort(morton(codes), kind="stable")).to(values["means"].device)
        values = {name: table[order].float() for name, table in values.items()}
        tables = {name: Rounded(table, torch.from_numpy(steps[name]).to(table)) for name, table in values.items()}
        self.tables = nn.ModuleDict(tables)
        self.density = Density(self._row(values))
        self.density_of_latents = Density(values["latents"])

    def forward(self, rounded: bool) -> dict[str, Tensor]:
        return {name: table(rounded) for name, table in self.tables.items()}

    def bits(self, tables: Mapping[str, Tensor]) -> Tensor:
        """Bits of each splat, [N], in tables that `forward` returned."""
        steps = {name: table.steps for name, table in self.tables.items()}
        bits = bits_of_places(tables["means"], steps["means"]) + self.density.bits(self._row(tables), self._row(steps))
        return bits + self.density_of_latents.bits(tables["latents"], steps["latents"])

    @torch.no_grad()
    def keep(self, kept: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Remove the splats that are not `kept`, bool [N], and their optimizer state."""
        for group, table in zip(optimizer.param_groups, self.tables.values(), strict=False):
            state = optimizer.state.pop(table.values, {})
            table.values = nn.Parameter(table.values[kept])
            group["params"] = [table.values]
            optimizer.state[table.values] = {key: value[kept] if value.ndim else value for key, value in state.items()}

    @staticmethod
    def _row(tables: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([tables[name] for name in COLUMNS], dim=-1)


def growth_without(model, field: Field, views: Iterable[tuple[Any, dict[str, Any]]]) -> tuple[Tensor, float]:
    """Growth of the views' squared error when one splat is removed, as a share of it, for each splat [N]; and the mean
    of the training's loss.

    A pixel is linear in the opacity of each splat alone: removing splat i takes d_p = dI_p / dg_i from each pixel p,
    where g_i = 1 multiplies its opacity, and the squared error grows by

        sum_p |d_p|^2 - 2 (I_p - truth_p) d_p.

    The second sum is the error's gradient by g_i. The first is the mean of (d sum_p s_p I_p / dg_i)^2 over random signs
    s_p (Hutchinson's estimator), one sample a view.

    Args:
        model: in training mode.
        views: training cameras and their photographs.
    """
    count = len(field.splats["means"])
    device = field.splats["means"].device
    growth, error, loss = (torch.zeros(n, device=device) for n in (count, 1, 1))
    for number, (camera, batch) in enumerate(views, 1):
        gates = torch.ones(count, device=device, requires_grad=True)
        view = model.project(camera, field.splats)
        seen = field.seen_from(view)
        gated = seen._replace(opacities=seen.opacities * gates[view.visible])
        outputs, _ = model.composite(view, gated, look=model.look_of(camera.metadata["cam_idx"]))
        off = outputs["rgb"] - model.truth_of(batch, outputs["background"])
        if (mask := model.mask_of(batch)) is not None:
            off = off * mask
        squared = off.square().sum()
        signs = torch.empty_like(off).bernoulli_().mul_(2.0).sub_(1.0)
        (of_error,) = torch.autograd.grad(squared, gates, retain_graph=True)
        (of_signs,) = torch.autograd.grad((off * signs).sum(), gates)
        growth += of_signs.square() - of_error
        error += squared.detach()
        loss += (photometric(model, outputs, batch).detach() - loss) / number
    return growth / error, float(loss)


@torch.no_grad()
def contributions_to(model, cameras: Cameras) -> Tensor:
    """Contribution of each splat of a model to its views: alpha T, summed over pixels and views. [N]"""
    total = torch.zeros(model.num_points, dtype=torch.float64, device=model.device)
    for index in range(len(cameras)):
        view, _, share = look_through(model, cameras[index : index + 1])
        total.index_add_(0, view.visible, share.clamp_min(0.0).double())
    return total.float()


def fine_tune(
    pipeline, steps: int, rate: float, on_report: Callable[[float], None], size: float | None = None
) -> tuple[Field, dict[str, np.ndarray], float]:
    """Fine-tune a trained field for its size in a file.

    Args:
        pipeline: of the trained model, in evaluation mode; its own splats stay as they are.
        rate: loss for a byte of each splat.
        on_report: called with the bits of all splats every REPORT_EVERY steps.
        size: bytes of the tables to arrive at, with whatever rate; `rate` begins. None: `rate` stays.

    Returns:
        the field; the grids' steps for each table's columns, on which its numbers lie; and the last rate. InputError
        where no splat would be left.
    """
    model, data = pipeline.model, pipeline.datamanager
    cameras = data.train_dataset.cameras
    noise = ViewNoise(model.noise_factor * camera_spacing(cameras.camera_to_worlds[:, :3, 3]), torch.initial_seed())
    field = model.field.detached()
    # Latents begin as their own principal components.
    field = with_rank(field, latent_basis(field, contributions_to(model, cameras)), field.head.config.latent_dim)
    head = field.head.requires_grad_(True).train()
    coded = CodedSplats(drawable(field.splats))
    count = len(coded.tables["means"].values)
    of_bits = torch.tensor(rate / (8 * count), device=model.device)  # loss of a bit
    smallest, largest = (limit / (8 * count) for limit in RATES_FOR_SIZE)
    haste = min(HASTE * EVERY / steps, HASTIEST)
    rates = RATES | {"means": RATES["means"] * model.scene_unit}
    rates["latents"] *= float(coded.tables["latents"].values.detach().std(dim=0, correction=0).max())
    groups = [
        *({"params": [table.values], "lr": rates[name]} for name, table in coded.tables.items()),
        {"params": [table.log_steps for table in coded.tables.values()], "lr": STEPS_RATE},
        {"params": [*coded.density.parameters(), *coded.density_of_latents.parameters()], "lr": DENSITY_RATE},
        {"params": list(head.parameters()), "lr": FIELD_RATE},
    ]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * min(step / steps, 1.0)))
    )
    prunings = [round(share * steps) for share in PRUNINGS]
    turns = torch.arange(count, device=model.device) % len(prunings)
    model.train()
    for step in range(steps):
        if step in prunings:
            with torch.no_grad():
                tables = coded(rounded=True)
                cost = coded.bits(tables) * (WORTH * of_bits)
            views = map(data.next_train, range(len(cameras)))
            growth, loss = growth_without(model, Field(head, splats_of(tables)), views)
            # The training's loss is about the root of the squared error.
            kept = (turns != prunings.index(step)) | (0.5 * loss * growth > cost)
            if not kept.any():
                raise InputError("No splat is worth its bytes. Give a smaller --rate, or a larger --size-mb.")
            coded.keep(kept, optimizer)
            turns = turns[kept]
        camera, batch = data.next_train(step)
        tables = coded(rounded=step >= NOISY * steps)
        splats = splats_of(tables)
        seen = noise.moved(splats, noise.generator(model.device, step))
        loss = photometric(model, model.render(Field(head, splats), camera, Field(head, seen)), batch)
        if step % EVERY == 0:
            bits = coded.bits(tables).sum()
            loss = loss + EVERY * of_bits * bits
            if size is not None:
                of_bits = (of_bits * (bits.detach() / (8 * size)) ** haste).clamp(smallest, largest)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % REPORT_EVERY == 0:
            on_report(float(bits.detach()))
    model.eval()
    with torch.no_grad():
        splats = splats_of(coded(rounded=True))
    grids = {name: table.steps.detach().cpu().double().numpy() for name, table in coded.tables.items()}
    field = Field(head.requires_grad_(False).eval(), splats)
    used = (splats["latents"] != 0).any(dim=0).nonzero()[:, 0]
    if 0 < len(used) < splats["latents"].shape[1]:
        field = with_components(field, used)
        grids["latents"] = grids["latents"][used.cpu().numpy()]
    return field, grids, float(of_bits) * 8 * count
