# SPDX-License-Identifier: Apache-2.0
"""The fused kernels beside PyTorch's field: cases, the rounding twin, and the judge. Shared by CPU and GPU tests."""

import torch
from torch import Tensor

from nrfgs_ns.appearance.nrf import NrfConfig

ULP = 2.0**-24
"""Relative rounding error of float32."""


def heads(device: str = "cpu", precision: str = "fp32", scale: float = 1.0, seed: int = 1, **config):
    """A fused field in float32, and PyTorch's in float64 with the same weights, `scale` times torch's initial ones."""
    torch.manual_seed(seed)
    config = {"output_init": "default", "precision": precision, **config}
    fused = NrfConfig(**config).setup()
    fused.fused.takes = lambda splats: True  # on the CPU, too, where Triton interprets
    for weight in fused.parameters():
        weight.data *= scale
    twin = NrfConfig(implementation="torch", **config).setup().double()
    twin.load_state_dict(fused.state_dict())
    return fused.to(device), twin.to(device)


def scene(head, count: int, visible: int, repeated: bool = False, seed: int = 0):
    """A float32 table of random splats, visible rows, and one centre [3]; if `repeated`, rows repeat, a centre each."""
    generator = torch.Generator().manual_seed(seed)
    device = next(head.parameters()).device
    torch.manual_seed(seed)
    splats = {
        "means": 2 * torch.rand(count, 3, generator=generator) - 1,
        "opacities": 3 * torch.randn(count, 1, generator=generator),
        **head.splat_params(2 * torch.rand(count, 3, generator=generator) - 0.5),
    }
    splats["latents"] = 5 * splats["latents"]
    if repeated:
        rows = torch.randint(count, (visible,), generator=generator)
        centers = 3 * torch.randn(visible, 3, generator=generator)
    else:
        rows = torch.randperm(count, generator=generator)[:visible]
        centers = 3 * torch.randn(3, generator=generator)
    return {name: value.to(device) for name, value in splats.items()}, rows.to(device), centers.to(device)


def evaluate(head, splats, visible, centers, dtype=torch.float32) -> dict[str, Tensor]:
    """Values, and the gradients of a fixed random sum of them, by name. A gradient that was not given is zero."""
    leaves = {name: value.detach().to(dtype).requires_grad_() for name, value in splats.items()}
    centers = centers.detach().to(dtype).requires_grad_()
    head.zero_grad(set_to_none=True)
    colors, opacities = head(leaves, visible, centers)
    generator = torch.Generator().manual_seed(7)
    d_colors = torch.randn(len(visible), 3, generator=generator).to(colors)
    d_opacities = torch.randn(len(visible), generator=generator).to(opacities)
    ((colors * d_colors).sum() + (opacities * d_opacities).sum()).backward()
    inputs = {**leaves, "centers": centers, **dict(head.named_parameters())}
    gradients = {f"d {name}": torch.zeros_like(x) if x.grad is None else x.grad for name, x in inputs.items()}
    return {"colors": colors.detach(), "opacities": opacities.detach(), **gradients}


def relative_errors(ours: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, float]:
    """Norm of the difference over the norm of what is exact, by name; the difference itself where that is zero."""
    errors = {}
    for name, value in exact.items():
        assert ours[name].shape == value.shape, name
        assert torch.isfinite(ours[name]).all(), name
        norm = value.norm().item()
        errors[name] = (ours[name].double() - value).norm().item() / (norm if norm > 0 else 1.0)
    return errors


def assert_near(ours: dict[str, Tensor], exact: dict[str, Tensor], tolerance: float | dict[str, float]) -> None:
    errors = relative_errors(ours, exact)
    limits = tolerance if isinstance(tolerance, dict) else dict.fromkeys(errors, tolerance)
    bad = {name: (error, limits[name]) for name, error in errors.items() if not error <= limits[name]}
    assert not bad, f"relative error, limit: {bad}"


def compare(head, twin, case, tolerance: float | dict[str, float]) -> None:
    assert_near(evaluate(head, *case), evaluate(twin, *case, dtype=torch.float64), tolerance)


def float32_tolerance(num_bands: int = 3) -> float:
    """Relative error of a result in float32.

    Four matrix products in a row (two forward, two back) of at most 128 terms, whose roundings add up like a random
    walk: 4 sqrt(128) ULP = 2.7e-6. The direction's own rounding is multiplied by the highest band's 2^(K-1) pi, forward
    and again in the slope; double angles multiply the first band's error likewise, and leave 2^(K-1) 4 ULP
    (test_bands_by_double_angles).
    """
    return (4 * 128**0.5 + 2 * 2.0 ** (num_bands - 1) * (torch.pi + 4)) * ULP


def round_to(kind: str, x: Tensor) -> Tensor:
    """What a factor of a product is rounded to, in x's own dtype; tf32 keeps 10 bits of mantissa."""
    if kind == "bf16":
        return x.to(torch.bfloat16).to(x.dtype)
    if kind == "fp16":
        return x.clamp(-65504, 65504).half().to(x.dtype)
    return ((x.float().view(torch.int32) + 0x1000) & -0x2000).view(torch.float32).to(x.dtype)


class RoundedLinear(torch.autograd.Function):
    """A linear layer whose products round both factors: to `kinds[0]`, and in the backward pass to `kinds[1]`."""

    @staticmethod
    def forward(ctx, x, weight, bias, kinds, round_bias):
        ctx.save_for_backward(x, weight)
        ctx.kind, ctx.round_bias = kinds[1], round_bias
        bias = round_to(kinds[0], bias) if round_bias else bias
        return round_to(kinds[0], x) @ round_to(kinds[0], weight).T + bias

    @staticmethod
    def backward(ctx, d_y):
        x, weight = (round_to(ctx.kind, tensor) for tensor in ctx.saved_tensors)
        rounded = round_to(ctx.kind, d_y)
        return rounded @ weight, rounded.T @ x, (rounded if ctx.round_bias else d_y).sum(0), None, None


def rounding(twin, kinds: tuple[str, str]):
    """Make the float64 twin round the factors of its products as the kernels do; the first bias is such a factor."""
    for branch in filter(None, (twin.low, twin.high)):
        for layer, first in ((branch[0], True), (branch[2], False)):
            layer.forward = lambda x, on=layer, first=first: RoundedLinear.apply(x, on.weight, on.bias, kinds, first)
    return twin
