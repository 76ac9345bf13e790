# SPDX-License-Identifier: Apache-2.0
"""Fitting: Adam for every model, and the least-squares optimum for harmonics.

Many samples are fitted in minibatches that never change: a block of samples, all its directions. Each block has its own
Adam state for what its samples store, the shared weights have one, so a sample's numbers move only when it is seen.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import torch
from torch import Tensor

from nrfgs_lab.express.models import DirectionalModel, Harmonics, Samples
from nrfgs_lab.express.targets import Targets
from nrfgs_ns.appearance.spherical_harmonics import sh_bases


@dataclass
class FitConfig:
    """How a model is fitted."""

    passes: int = 500
    """how often each sample is seen"""
    sample_lr: float = 0.01
    """Adam's learning rate for what samples store"""
    shared_lr: float = 0.01
    """and for the shared weights"""
    final_lr: float = 0.01
    """learning rate at the end, as a fraction; the decay is exponential"""
    block: int = 82
    """most samples in a minibatch; the shared weights take a step for each"""

    def steps(self, num_samples: int) -> int:
        """Steps of the shared weights."""
        return self.passes * math.ceil(num_samples / self.block)


@dataclass
class Fitted:
    """A fitted model."""

    model: DirectionalModel
    samples: Samples
    seconds: float

    def colors(self, directions: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """[S, D, 3] of the samples in `rows`."""
        with torch.no_grad():
            return self.model({name: tensor[rows] for name, tensor in self.samples.items()}, directions)


def fit(
    build: Callable[[], DirectionalModel],
    targets: Targets,
    config: FitConfig,
    seed: int,
    on_step: Callable[[], None] = lambda: None,
) -> Fitted:
    """Minimise the mean square error at the training directions. `build` makes the model, under torch's seed `seed`;
    `on_step` is called after each step.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = build()
    generator = torch.Generator().manual_seed(seed)
    # Random numbers are drawn on the CPU, so that every device starts from the same ones.
    samples = model.start(targets.colors.mean(dim=1).cpu(), generator)
    device = targets.colors.device
    model, samples = model.to(device), {name: tensor.to(device) for name, tensor in samples.items()}
    blocks = torch.randperm(len(targets), generator=generator).to(device).split(config.block)
    stored = [{name: tensor[rows].requires_grad_() for name, tensor in samples.items()} for rows in blocks]
    optimisers = [torch.optim.Adam(block.values(), lr=config.sample_lr) for block in stored]
    weights = list(model.parameters())
    shared = torch.optim.Adam(weights, lr=config.shared_lr) if weights else None
    clock = perf_counter()
    steps = config.passes * len(blocks)
    for step in range(steps):
        decay = config.final_lr ** (step / steps)
        which = step % len(blocks)
        set_rate(optimisers[which], config.sample_lr * decay)
        optimisers[which].zero_grad()
        if shared is not None:
            set_rate(shared, config.shared_lr * decay)
            shared.zero_grad()
        model.set_progress(step / steps)
        colors = model(stored[which], targets.directions)
        loss = (colors - targets.colors[blocks[which]]).square().mean()
        loss.backward()
        optimisers[which].step()
        if shared is not None:
            shared.step()
        on_step()
    seconds = perf_counter() - clock
    model.set_progress(1.0)
    with torch.no_grad():
        for rows, block in zip(blocks, stored, strict=True):
            for name, tensor in block.items():
                samples[name][rows] = tensor
    return Fitted(model, samples, seconds)


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all groups."""
    for group in optimiser.param_groups:
        group["lr"] = rate


def least_squares(targets: Targets, degree: int = 3) -> Fitted:
    """Harmonics at their optimum over the training directions; the shortest coefficients where there are several."""
    clock = perf_counter()
    inverse = torch.linalg.pinv(sh_bases(degree, targets.directions.double()))  # [B, D]
    coefficients = torch.einsum("bd,sdc->sbc", inverse.float(), targets.colors - 0.5)
    return Fitted(Harmonics(degree), {"coefficients": coefficients}, perf_counter() - clock)


def psnr(mean_square: float) -> float:
    """-10 log10 of it: decibels for a peak of 1."""
    return -10.0 * math.log10(max(mean_square, 1e-12))


def measure(fitted: Fitted, targets: Targets, block: int = 2000) -> dict[str, float]:
    """PSNR over all samples, directions and channels pooled, peak 1.

    Returns:
        train_psnr and held_out_psnr of the values as they are, and the same with `_clamped` of values clamped to
        [0, 1], as a picture would be.
    """
    result = {}
    for name, directions, colors in (
        ("train", targets.directions, targets.colors),
        ("held_out", targets.held_out_directions, targets.held_out_colors),
    ):
        plain = clamped = 0.0
        for start in range(0, len(colors), block):
            rows = slice(start, start + block)
            predicted, truth = fitted.colors(directions, rows), colors[rows]
            plain += (predicted - truth).double().square().sum().item()
            clamped += (predicted.clamp(0.0, 1.0) - truth).double().square().sum().item()
        result[f"{name}_psnr"] = psnr(plain / colors.numel())
        result[f"{name}_psnr_clamped"] = psnr(clamped / colors.numel())
    return result


def linear_bound(targets: Targets, numbers: int) -> float:
    """PSNR on the training directions of the best linear code of `numbers` numbers per sample.

    Principal components of the samples' colours: no model that is linear in so many numbers per sample can be better.
    The components themselves, which the samples share, are not counted, and nothing is said of other directions.
    """
    rows = targets.colors.flatten(1).double()
    rows = rows - rows.mean(dim=0)
    energy = torch.linalg.eigvalsh(rows.T @ rows).clamp_min(0.0)
    return psnr(energy[: max(len(energy) - numbers, 0)].sum().item() / rows.numel())
