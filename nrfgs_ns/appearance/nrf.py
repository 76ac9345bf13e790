# SPDX-License-Identifier: Apache-2.0
"""The neural residual field: one tiny network, shared by the scene, that adds a bounded residual to every splat.

Splat i stores a mean x, a base colour c, a base opacity alpha and a latent z. For a camera centre o let

    v = o - x,    r = max(|v|, eps),    d = v / r,

low(d) be d and its Fourier band 0, and high(d) bands 1 to K - 1; band k is sin(2^k pi d) and cos(2^k pi d). Then

    (dc_low, d_alpha) = low branch (z, c, alpha, log r, low(d))
    (dc_high, w)      = high branch(z, c,        log r, high(d))

    colour  = c     + s_c     tanh(dc_low + sigmoid(w) dc_high)
    opacity = alpha + s_alpha tanh(d_alpha)

The gate w lets detail through only where it pays. Both branches are one hidden layer of ReLUs: 46 -> 64 -> 4 and
48 -> 64 -> 4, 6,664 weights at the default sizes. Without the split, one branch of twice the width sees everything
(58 -> 128 -> 4, 8,068 weights), without a gate.

Two bounds keep opacity in [0, 1], with t = tanh(d_alpha) and a = alpha + s_alpha t:

    straight-through   min(max(a, 0), 1), with the gradient of a, so that a splat beyond an end can come back
    logit              sigmoid(logit + 4 s_alpha t); at half opacity, to first order, alpha + s_alpha t

On the logit the residual scales with the opacity: n copies of a splat, each of about alpha / n, together look like one.
`fused/` computes the same function in two GPU kernels.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, get_args, get_type_hints

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.fused import FusedField
from nrfgs_ns.appearance.head import NEAR, AppearanceHead, AppearanceHeadConfig, Component, SplatAppearance, base_colors

OpacityBound = Literal["straight-through", "logit"]
OPACITY_BOUNDS: tuple[OpacityBound, ...] = get_args(OpacityBound)
LOGIT_SLOPE = 4.0
"""Slope of the logit at half opacity, dlogit/dalpha = 1 / (alpha (1 - alpha))."""
LATENT_STD = 0.1
"""Standard deviation of the initial latents."""
FARTHEST = 1e18
"""Coordinates of v are clamped to this, without gradient beyond: their squares must stay below float32's 3e38."""
BAND_DIM = 6
"""Numbers in a band: sin and cos of three coordinates."""


@dataclass
class NrfConfig(AppearanceHeadConfig):
    """Neural residual field. The defaults are the paper's, except for zero outputs and `opacity_bound`."""

    _target: type = field(default_factory=lambda: NeuralResidualField)
    latent_dim: int = 32
    """numbers in a splat's latent (D)"""
    num_bands: int = 3
    """Fourier bands of the view direction (K); band 0 is low, the others are high"""
    hidden_width: int = 64
    """hidden units of each branch; a single branch has twice as many"""
    split_bands: bool = True
    """one branch for low and one for high bands, joined by a gate; otherwise a single branch"""
    opacity_residual: bool = True
    """the field changes opacity with the view"""
    use_distance: bool = True
    """the field sees the log distance to the camera"""
    color_scale: float = 0.2
    """largest change of a colour channel (s_c), in units of white"""
    opacity_scale: float = 0.2
    """largest change of opacity (s_alpha); twice this with error-guided and mcmc, unless `opacity_bound` is given"""
    distance_eps: float = NEAR
    """smallest camera distance, in scene units; shorter ones count as this. The near plane"""
    output_init: Literal["zero", "default"] = "zero"
    """start of the output layers. zero: no residual. default: torch's, as in the paper, followed by the warm-up"""
    opacity_bound: OpacityBound | None = None
    """how base + residual stays in [0, 1] (docs/deviations.md). straight-through: by a clamp that the gradient ignores.
    logit: added to the logit. None: logit with error-guided and mcmc, otherwise straight-through"""
    implementation: Literal["auto", "torch", "fused"] = "auto"
    """auto: fused Triton kernels on CUDA where they can run, PyTorch elsewhere. fused: the same, in older files"""
    precision: Literal["fp32", "tf32", "bf16", "fp16"] = "bf16"
    """rounding in matrix products of the fused kernels; sums are float32"""

    @property
    def bound(self) -> OpacityBound:
        """The chosen opacity bound, or the default one."""
        return self.opacity_bound or "straight-through"

    def trusted(self, share: float) -> "NrfConfig":
        """A smaller opacity residual: view-dependent opacity lets each view have its own geometry."""
        return replace(self, opacity_scale=share * self.opacity_scale) if self.opacity_residual else self

    def for_copies(self) -> "NrfConfig":
        """Twice the residual by default, on the logit: each part of a splat would add a whole one to its opacity."""
        on_logit = {"opacity_bound": "logit", "opacity_scale": 2 * self.opacity_scale}
        return self if self.opacity_bound or not self.opacity_residual else replace(self, **on_logit)

    def validate(self) -> None:
        self.require(1 <= self.latent_dim <= 1024, "latent_dim", "from 1 to 1024")
        self.require(self.num_bands >= 1, "num_bands", "at least 1")
        self.require(1 <= self.hidden_width <= 4096, "hidden_width", "from 1 to 4096")
        for name in ("color_scale", "opacity_scale"):
            self.require(getattr(self, name) >= 0, name, "zero or positive")
        self.require(self.distance_eps > 0, "distance_eps", "positive")
        hints = get_type_hints(NrfConfig)
        literals = {name: get_args(hints[name]) for name in ("output_init", "implementation", "precision")}
        for name, choices in {**literals, "opacity_bound": (None, *OPACITY_BOUNDS)}.items():
            self.require(getattr(self, name) in choices, name, "one of " + ", ".join(map(repr, choices)))


class Branches(NamedTuple):
    """Base appearance of M splats, and the branches' outputs before any tanh; None where the configuration has none."""

    color: Tensor  # c, not clamped, [M, 3]
    logit: Tensor  # logit of alpha, [M, 1]
    dc_low: Tensor  # [M, 3]; from the single branch, if there is only one
    dc_high: Tensor | None  # [M, 3]
    gate: Tensor | None  # sigmoid(w), [M, 1]
    d_alpha: Tensor | None  # [M, 1]


class NeuralResidualField(AppearanceHead):
    """The field, as in the module's docstring."""

    name = "nrf"

    def __init__(self, config: NrfConfig):
        super().__init__()
        shared = config.latent_dim + 3 + int(config.use_distance)  # z, c, log r
        low = 1 + 3 + BAND_DIM  # alpha, d and band 0
        high = BAND_DIM * (config.num_bands - 1)  # the other bands
        outputs = 3 + int(config.opacity_residual)  # dc, d_alpha
        split, width = config.split_bands, config.hidden_width
        self.low = mlp(shared + low, width, outputs) if split else mlp(shared + low + high, 2 * width, outputs)
        self.high = mlp(shared + high, width, 3 + 1) if split and high > 0 else None  # dc, gate
        branches = [branch for branch in (self.low, self.high) if branch is not None]
        if config.output_init == "zero":
            for branch in branches:
                nn.init.zeros_(branch[-1].weight)
                nn.init.zeros_(branch[-1].bias)
        self.fused = FusedField(config, branches)

    def try_kernels(self, device: torch.device) -> None:
        if self.config.implementation != "torch":
            self.fused.prepared_on(device)

    def splat_params(self, rgb: Tensor) -> dict[str, Tensor]:
        """Base colours and latents: "features_dc" [N, 3], "latents" [N, D] ~ N(0, LATENT_STD^2)."""
        latents = torch.randn(len(rgb), self.config.latent_dim, device=rgb.device) * LATENT_STD
        return {**super().splat_params(rgb), "latents": latents}

    def forward(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> SplatAppearance:
        if self.fused.takes(splats):  # Triton, on CUDA
            return SplatAppearance(*self.fused(splats, visible, camera_centers, self.scene_unit))
        out = self._branches(splats, visible, camera_centers)
        opacities = self._opacity(out).squeeze(-1)
        return SplatAppearance((out.color + self._color_residual(out)).clamp_min(0.0), opacities)

    def components(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> dict[str, Component]:
        """The residuals of colour, before the clamp at black, and opacity; with two branches also both and the gate.

        "low branch" is the colour residual with a shut gate, s_c tanh(dc_low); "high branch" is the difference between
        "residual" and it.
        """
        out = self._branches(splats, visible, camera_centers)
        residual = self._color_residual(out)
        shown = {"residual": Component(residual, "color")}
        if out.gate is not None:
            low = self._color_residual(out._replace(dc_high=None))
            shown["low branch"] = Component(low, "color")
            shown["high branch"] = Component(residual - low, "color")
            shown["gate weight"] = Component(out.gate, "weight")
        if out.d_alpha is not None:
            shown["opacity residual"] = Component(self._opacity(out) - torch.sigmoid(out.logit), "opacity")
        return shown

    def neutral_loss(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> Tensor:
        """Mean square of the colour and opacity residuals."""
        out = self._branches(splats, visible, camera_centers)
        loss = self._color_residual(out).square().mean()
        if out.d_alpha is None:
            return loss
        opacity_residual = self.config.opacity_scale * torch.tanh(out.d_alpha)
        return loss + opacity_residual.square().mean()

    def _branches(self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor) -> Branches:
        means, latents, features_dc, logit = (
            splats[name].index_select(0, visible) for name in ("means", "latents", "features_dc", "opacities")
        )
        color = base_colors(features_dc)
        directions, log_distance = view_geometry(means, camera_centers, self.config.distance_eps, self.scene_unit)
        low, high = fourier_bands(directions, self.config.num_bands)

        shared = [latents, color] + ([log_distance] if self.config.use_distance else [])
        bands = [low] if self.config.split_bands else [low, high]  # a single branch sees all
        low_outputs = self.low(torch.cat([*shared, torch.sigmoid(logit), *bands], dim=-1))
        dc_low = low_outputs[:, :3]
        d_alpha = low_outputs[:, 3:] if self.config.opacity_residual else None
        dc_high = gate = None
        if self.high is not None:
            high_outputs = self.high(torch.cat([*shared, high], dim=-1))
            dc_high = high_outputs[:, :3]
            gate = torch.sigmoid(high_outputs[:, 3:])
        return Branches(color, logit, dc_low, dc_high, gate, d_alpha)

    def _color_residual(self, out: Branches) -> Tensor:
        """Colour residual s_c tanh(dc_low + sigmoid(w) dc_high), [M, 3]."""
        dc = out.dc_low if out.dc_high is None else out.dc_low + out.gate * out.dc_high
        return self.config.color_scale * torch.tanh(dc)

    def _opacity(self, out: Branches) -> Tensor:
        """Opacity as the view shows it, [M, 1]."""
        if out.d_alpha is None:
            return torch.sigmoid(out.logit)
        return bounded_opacity(out.logit, torch.tanh(out.d_alpha), self.config.opacity_scale, self.config.bound)


def view_geometry(means: Tensor, camera_centers: Tensor, eps: float, unit: float = 1.0) -> tuple[Tensor, Tensor]:
    """Directions d = v / r from splats to their cameras, and log r, for v = o - x and r = max(|v|, eps).

    The gradient of d is at most 1 / eps, also with the camera on the splat.

    Args:
        means: [M, 3], world units.
        camera_centers: [3] or [M, 3], world units.
        eps: smallest distance, in scene units, > 0; shorter ones count as this.
        unit: world units in a scene unit.

    Returns:
        d [M, 3], shorter than 1 where |v| < eps; log r with r in scene units, [M, 1], >= log eps.
    """
    v = (camera_centers - means).clamp(-FARTHEST, FARTHEST)
    r = v.square().sum(dim=-1, keepdim=True).clamp_min((eps * unit) ** 2).sqrt()
    return v / r, r.log() - math.log(unit)


def fourier_bands(directions: Tensor, num_bands: int) -> tuple[Tensor, Tensor]:
    """Fourier bands of directions [M, 3], K >= 1: band k holds sin(2^k pi d) and cos(2^k pi d).

    Returns:
        low [M, 9], raw d and band 0; high [M, 6 (K - 1)], bands 1 to K - 1.
    """
    frequencies = math.pi * 2.0 ** torch.arange(num_bands, device=directions.device, dtype=directions.dtype)
    angles = directions[:, None, :] * frequencies[:, None]  # [M, K, 3]
    waves = torch.cat([angles.sin(), angles.cos()], dim=-1)  # [M, K, 6]
    return torch.cat([directions, waves[:, 0]], dim=-1), waves[:, 1:].flatten(1)


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """One hidden layer of ReLUs, with biases."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def bounded_opacity(logit: Tensor, residual: Tensor, scale: float, bound: OpacityBound) -> Tensor:
    """Opacity with its residual, in [0, 1]: [M, 1].

    Args:
        logit: base opacities' logits, [M, 1].
        residual: t, [M, 1], in [-1, 1].
        scale: s_alpha >= 0, the largest change of opacity (for "logit": at half opacity and to first order).
    """
    if bound == "logit":
        return torch.sigmoid(logit + LOGIT_SLOPE * scale * residual)
    unbounded = torch.sigmoid(logit) + scale * residual
    return unbounded + (unbounded.clamp(0.0, 1.0) - unbounded).detach()
