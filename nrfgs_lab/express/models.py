# SPDX-License-Identifier: Apache-2.0
"""The colour models on a grid: S samples, each seen from the same D directions, no geometry and no opacity.

They are the appearance heads' formulas (the tests hold them together), but evaluated on the grid: the first layer of a
network that reads (sample, direction) is a sum of a part for each sample and a part for each direction, so most of its
multiplications are shared. Colours are not clamped here. Directions are from the sample to the viewer; the heads that
look the other way (harmonics, lobes, learnt basis) differ by a reflection of their parameters only.

What a sample stores is a dictionary of tensors [S, ...]; what the samples share is the module's own parameters.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.encoding import LOW_DIM, fourier_bands, high_dim
from nrfgs_ns.appearance.head import SH_C0
from nrfgs_ns.appearance.nrf import mlp
from nrfgs_ns.appearance.spherical_harmonics import num_bases, sh_bases

Samples = dict[str, Tensor]


class DirectionalModel(nn.Module, ABC):
    """Colours over directions."""

    @abstractmethod
    def start(self, mean: Tensor, generator: torch.Generator) -> Samples:
        """What the samples store before the fit.

        Args:
            mean: each sample's mean colour over the training directions, [S, 3]. Every model starts from it.
            generator: for what is random.
        """

    @abstractmethod
    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        """Colours [S, D, 3] at unit directions [D, 3]."""

    def set_progress(self, fraction: float) -> None:  # noqa: B027  (most models have no schedule)
        """Tell the model how much of the fit is done, in [0, 1]."""

    def numbers_per_sample(self) -> int:
        """How many numbers a sample stores."""
        samples = self.start(torch.zeros(1, 3), torch.Generator())
        return sum(tensor.numel() for tensor in samples.values())

    def num_shared(self) -> int:
        """How many weights the samples share."""
        return sum(parameter.numel() for parameter in self.parameters())

    def count(self, num_samples: int) -> int:
        """Parameters in all."""
        return num_samples * self.numbers_per_sample() + self.num_shared()


class Harmonics(DirectionalModel):
    """1/2 + sum_j k_j Y_j(d)."""

    def __init__(self, degree: int = 3):
        super().__init__()
        self.degree = degree

    def start(self, mean: Tensor, generator: torch.Generator) -> Samples:
        coefficients = torch.zeros(len(mean), num_bases(self.degree), 3)
        coefficients[:, 0] = (mean - 0.5) / SH_C0
        return {"coefficients": coefficients}

    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        return 0.5 + torch.einsum("db,sbc->sdc", sh_bases(self.degree, directions), samples["coefficients"])


class Field(DirectionalModel):
    """The study's field: one network (z, c, bands(d)) -> width -> 3, added to the base colour.

    Args:
        latent_dim: numbers in a latent.
        width: hidden units.
        bands: Fourier bands K; the direction gives 3 + 6 K numbers.
        bound: largest change of a channel, as bound * tanh; None leaves the output as it is.
        zero_output: start with no residual, as the head does; else with torch's default.
        latent_std: deviation of the initial latents.
    """

    def __init__(
        self,
        latent_dim: int = 32,
        width: int = 64,
        bands: int = 4,
        bound: float | None = None,
        zero_output: bool = False,
        latent_std: float = 0.1,
    ):
        super().__init__()
        self.latent_dim, self.bands, self.bound, self.latent_std = latent_dim, bands, bound, latent_std
        self.network = mlp(latent_dim + 3 + 3 + 6 * bands, width, 3)
        if zero_output:
            zero(self.network)

    def start(self, mean: Tensor, generator: torch.Generator) -> Samples:
        latents = torch.randn(len(mean), self.latent_dim, generator=generator) * self.latent_std
        return {"base": mean.clone(), "latents": latents}

    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        own = torch.cat([samples["latents"], samples["base"]], dim=-1)
        out = grid_mlp(self.network, own, torch.cat(fourier_bands(directions, self.bands), dim=-1))
        return samples["base"][:, None] + bounded(out, self.bound)


class SplitField(DirectionalModel):
    """The head's field: a low and a high branch joined by a gate. Distance and opacity, constant here, are left out.

    Arguments as for `Field`.
    """

    def __init__(
        self,
        latent_dim: int = 32,
        width: int = 64,
        bands: int = 3,
        bound: float | None = 0.2,
        zero_output: bool = True,
        latent_std: float = 0.1,
    ):
        super().__init__()
        self.latent_dim, self.bands, self.bound, self.latent_std = latent_dim, bands, bound, latent_std
        self.low = mlp(latent_dim + 3 + LOW_DIM, width, 3)
        self.high = mlp(latent_dim + 3 + high_dim(bands), width, 3 + 1)
        if zero_output:
            zero(self.low)
            zero(self.high)

    start = Field.start

    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        own = torch.cat([samples["latents"], samples["base"]], dim=-1)
        low, high = fourier_bands(directions, self.bands)
        detail = grid_mlp(self.high, own, high)
        out = grid_mlp(self.low, own, low) + torch.sigmoid(detail[..., 3:]) * detail[..., :3]
        return samples["base"][:, None] + bounded(out, self.bound)


class Lobes(DirectionalModel):
    """Base colour and L spherical Gaussians: c + sum_j a_j exp(|s_j| (d . mu_j - 1))."""

    def __init__(self, lobes: int = 6, sharpness: float = 2.0):
        super().__init__()
        self.lobes, self.sharpness = lobes, sharpness

    def start(self, mean: Tensor, generator: torch.Generator) -> Samples:
        axes = torch.cat([torch.eye(3), -torch.eye(3)])[: self.lobes]
        return {
            "base": mean.clone(),
            "axes": axes.repeat(len(mean), 1, 1),
            "sharpness": torch.full((len(mean), self.lobes), self.sharpness),
            "colors": torch.zeros(len(mean), self.lobes, 3),
        }

    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        axes = nn.functional.normalize(samples["axes"], dim=-1)
        cosines = directions @ axes.transpose(1, 2)  # [S, D, L]
        heights = torch.exp(samples["sharpness"].abs()[:, None] * (cosines - 1.0))
        return samples["base"][:, None] + heights @ samples["colors"]


class LearntBasis(DirectionalModel):
    """GSNB: 1/2 + sum_j k_j (Y_j(d) + rho phi_j(d)), phi from a network of the direction alone.

    rho grows from 0 to 1 over the first sixth of the fit, as over 5,000 of the method's 30,000 steps.
    """

    def __init__(self, degree: int = 3, width: int = 64, bands: int = 6):
        super().__init__()
        self.harmonics, self.bands, self.ramp = Harmonics(degree), bands, 1.0
        self.network = deep_mlp(3 + 6 * bands, width, num_bases(degree))

    def start(self, mean: Tensor, generator: torch.Generator) -> Samples:
        return self.harmonics.start(mean, generator)

    def set_progress(self, fraction: float) -> None:
        self.ramp = min(6.0 * fraction, 1.0)

    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        learnt = self.network(torch.cat(fourier_bands(directions, self.bands), dim=-1)).tanh()
        bases = sh_bases(self.harmonics.degree, directions) + self.ramp * learnt
        return 0.5 + torch.einsum("db,sbc->sdc", bases, samples["coefficients"])


class FactoredHarmonics(DirectionalModel):
    """What is left of VDGS without opacity and position: harmonics whose coefficients a network turns down.

    1/2 + sum_j f_j(d, z) k_j Y_j(d) with f = sigmoid(network), one factor for each coefficient and channel. VDGS reads
    features from a hash grid at the splat's position; a sample has no position, so it stores its features.
    """

    def __init__(self, degree: int = 2, features: int = 13, width: int = 32):
        super().__init__()
        self.harmonics, self.features = Harmonics(degree), features
        self.network = deep_mlp(3 + features, width, 3 * num_bases(degree))

    def start(self, mean: Tensor, generator: torch.Generator) -> Samples:
        coefficients = 2.0 * self.harmonics.start(mean, generator)["coefficients"]  # the factors start near 1/2
        features = torch.randn(len(mean), self.features, generator=generator) * 0.1
        return {"coefficients": coefficients, "features": features}

    def forward(self, samples: Samples, directions: Tensor) -> Tensor:
        factors = grid_mlp(self.network, samples["features"], directions).sigmoid().unflatten(-1, (-1, 3))
        bases = sh_bases(self.harmonics.degree, directions)
        return 0.5 + torch.einsum("sdbc,db,sbc->sdc", factors, bases, samples["coefficients"])


def bounded(residual: Tensor, bound: float | None) -> Tensor:
    """Bound * tanh(residual), or the residual itself."""
    return residual if bound is None else bound * residual.tanh()


def zero(network: nn.Sequential) -> None:
    """Zero the output layer."""
    nn.init.zeros_(network[-1].weight)
    nn.init.zeros_(network[-1].bias)


def deep_mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of leaky ReLUs, with biases."""
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.LeakyReLU(), nn.Linear(hidden, hidden), nn.LeakyReLU(), nn.Linear(hidden, outputs)
    )


def grid_linear(layer: nn.Linear, own: Tensor, directional: Tensor) -> Tensor:
    """`layer` on every pair of a sample's inputs own [S, A] and a direction's inputs [D, B]: [S, D, outputs]."""
    split = own.shape[-1]
    per_sample = nn.functional.linear(own, layer.weight[:, :split], layer.bias)
    return per_sample[:, None] + nn.functional.linear(directional, layer.weight[:, split:])


def grid_mlp(network: nn.Sequential, own: Tensor, directional: Tensor) -> Tensor:
    """`network` on every pair, as `grid_linear`."""
    hidden = grid_linear(network[0], own, directional)
    for layer in network[1:]:
        hidden = layer(hidden)
    return hidden


def largest(build: Callable[[int], DirectionalModel], sizes: range, num_samples: int, budget: int) -> int:
    """The largest of the increasing `sizes` at which the model has at most `budget` parameters.

    Raises:
        ValueError: not even the smallest fits.
    """
    for size in reversed(sizes):
        if build(size).count(num_samples) <= budget:
            return size
    raise ValueError(f"no size from {sizes} fits {num_samples} samples into {budget} parameters")
