# SPDX-License-Identifier: Apache-2.0
"""Tables of splats and small trainings that the tests of densification share."""

from collections.abc import Callable
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation
from short_trainings import command_line
from torch.nn import Parameter

from nrfgs_ns.densification import STRATEGIES as CONFIGS
from nrfgs_ns.densification import UNSEEN

STRATEGIES = ("splatfacto", "original", "mcmc")
REFINES = 1000
"""A step at which every strategy refines by default: more than 8 images + 100 steps after the reset at 0."""


def logit(value: float) -> float:
    return torch.logit(torch.tensor(value, dtype=torch.float64)).item()


class Table:
    """`count` splats with Adam's moments; row i has the latent (i, i, i), and means far from all others."""

    def __init__(self, count: int, opacity: float = 0.5, scale: float = 0.001):
        rows = torch.arange(count, dtype=torch.float32)[:, None]
        tables = {
            "means": rows * torch.tensor([1.0, 0.0, 0.0]),
            "scales": torch.full((count, 3), scale).log(),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            "opacities": torch.full((count, 1), logit(opacity)),
            **{name: rows.repeat(1, 3) for name in ("features_dc", "latents")},
        }
        self.splats = torch.nn.ParameterDict({name: Parameter(table) for name, table in tables.items()})
        self.optimizers = {name: torch.optim.Adam([value], lr=1e-9) for name, value in self.splats.items()}
        for name, value in self.splats.items():
            value.grad = torch.ones_like(value)
            self.optimizers[name].step()
            self.optimizers[name].zero_grad()
        self.optimizers["field"] = torch.optim.Adam([Parameter(torch.zeros(4))])

    def __len__(self) -> int:
        return len(self.splats["means"])

    def set_opacity(self, rows: int | slice, opacity: float) -> None:
        self.splats["opacities"].data[rows] = logit(opacity)

    def info(self, gradient: float | torch.Tensor = 0.0, absgrad: torch.Tensor | None = None) -> dict:
        """A 100 x 100 picture that shows every splat, each with this gradient along x in units of half the picture."""
        means2d = torch.zeros(len(self), 2, requires_grad=True)
        along_x = torch.as_tensor(gradient).expand(len(self)) / 50.0
        means2d.grad = torch.stack([along_x, torch.zeros_like(along_x)], dim=1)
        means2d.absgrad = means2d.grad.clone() if absgrad is None else absgrad
        means2d.retain_grad = lambda: None
        rows = {"gaussian_ids": torch.arange(len(self)), "radii": torch.ones(len(self), dtype=torch.int32)}
        return {"means2d": means2d, **rows, "width": 100, "height": 100, "n_cameras": 1}

    def step(
        self,
        strategy,
        step: int,
        gradient: float | torch.Tensor = 0.0,
        shown: float | torch.Tensor | Callable[[torch.Tensor], torch.Tensor] = 0.5,
        seen: slice | torch.Tensor = slice(None),
        absgrad: torch.Tensor | None = None,
        **changed: torch.Tensor,
    ) -> None:
        """One training step; the splats in `seen` have the effective opacity `shown`, or what it makes of the stored
        ones, which it is given as heads compute them. `changed` are other entries of `info`."""
        info = self.info(gradient, absgrad) | changed
        rows, logits = info["gaussian_ids"][seen], self.splats["opacities"]
        stored = torch.sigmoid(logits.detach().index_select(0, rows)).squeeze(-1)
        opacities = shown(stored) if callable(shown) else torch.as_tensor(shown).expand_as(stored)
        view = {**info, "gaussian_ids": rows, "radii": info["radii"][rows]}
        strategy.pre_backward(step, view, opacities, logits)
        if "change" in view:
            info["change"] = torch.full((len(self),), UNSEEN).index_copy(0, rows, view["change"])
        strategy.post_backward(step, info, self.splats, self.optimizers)

    def check(self) -> None:
        """All tensors and moments have a row per splat, and the optimisers hold the table's parameters."""
        for name, value in self.splats.items():
            (held,) = self.optimizers[name].param_groups[0]["params"]
            assert held is value and len(value) == len(self)
            state = self.optimizers[name].state[value]
            assert state["exp_avg"].shape == state["exp_avg_sq"].shape == value.shape
        assert torch.isfinite(torch.cat([value.detach().flatten() for value in self.splats.values()])).all()


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions w, x, y, z of any length, by SciPy."""
    return torch.from_numpy(Rotation.from_quat(quats.detach().roll(-1, dims=-1).numpy()).as_matrix()).float()


def strategy(name: str, images: int = 8, **options):
    return CONFIGS[name](**options).build(images, images, 1.0)


def arguments(scene: Path, out: Path, densification: str, steps: int = 20, **rules) -> list[str]:
    """ns-train's command line: refinement every 4th step."""
    rules = {"warmup_length": 2, "refine_every": 4, **rules}
    if densification == "splatfacto":
        rules = {"densify_grad_thresh": 1e-6, "reset_alpha_every": 6, **rules}
    if densification == "error-guided":
        rules = {"threshold": 1e-4, **rules}
    options = {
        "--pipeline.model.densification": str(CONFIGS[densification](**rules)),
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.few-views": "off",
    }
    return command_line("nrfgs", scene, out, steps, options)
