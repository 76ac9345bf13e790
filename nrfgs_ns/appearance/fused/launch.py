# SPDX-License-Identifier: Apache-2.0
"""The kernels as one differentiable function of tables, camera centres and shared weights.

A training step of a small scene is bound by the host, so this is written for few launches: two to pack the weights,
one forward, one to zero the tables' gradients, one backward, two to sum and unpack the weights' gradients.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.appearance.fused.kernels import INTERPRETED, backward_kernel, forward_kernel
from nrfgs_ns.appearance.fused.packing import CENTER_SLOTS, Packing
from nrfgs_ns.appearance.head import SH_C0


@dataclass(frozen=True)
class Launch:
    """How a kernel is launched."""

    block: int
    """visible splats that a program takes at once"""
    warps: int
    """warps of a program"""
    stages: int
    """software pipelining of the loop over blocks; 1 is none"""
    programs_per_sm: int
    """programs for each multiprocessor; a program walks over many blocks"""


KINDS = {
    "fp32": ("tf32x3", "tf32x3"),
    "tf32": ("tf32", "tf32"),
    "bf16": ("bf16", "bf16"),
    "fp16": ("fp16", "bf16"),
}
"""How products are taken, without and with gradients among the factors, for each NrfConfig.precision. float32 is three
tf32 products on the tensor cores, which a float32 multiply-add is many times slower than. Gradients are never fp16: a
loss that is a mean over pixels gives them any size down to 1e-10, below what fp16 holds, and scaling each tile by its
largest number would cost a reduction over the tile and a multiplication after every product. bf16 has float32's
range; its rounding is unbiased and averages out over the splats."""

# Chosen by benchmarks/head_gpu.py --sweep on an H200 (tf32, bf16), and by the compiler's account of registers, spills
# and instructions (fp32). A tensor core's tile has 64 rows. Backward, the weights' gradients and the activations fill
# the registers (255 a thread, 65,536 a multiprocessor), so that 8 warps run at once. float32's three products take
# 208 KB of shared memory at 32 splats, of 227 KB on an H100 or H200.
FORWARD: dict[str, Launch] = {
    "fp32": Launch(block=64, warps=4, stages=1, programs_per_sm=1),
    "tf32": Launch(block=64, warps=4, stages=1, programs_per_sm=3),
    "bf16": Launch(block=64, warps=4, stages=1, programs_per_sm=3),
    "fp16": Launch(block=64, warps=4, stages=1, programs_per_sm=3),
}
BACKWARD: dict[str, Launch] = {
    "fp32": Launch(block=32, warps=8, stages=1, programs_per_sm=1),
    "tf32": Launch(block=128, warps=8, stages=1, programs_per_sm=1),
    "bf16": Launch(block=64, warps=4, stages=1, programs_per_sm=2),
    "fp16": Launch(block=64, warps=4, stages=1, programs_per_sm=2),
}
INTERPRETER_PROGRAMS = 2
"""Programs in Triton's interpreter: as few as show that programs share the work."""


@dataclass(frozen=True)
class FieldOptions:
    """What of the field's configuration the kernels need."""

    color_scale: float
    opacity_scale: float
    distance_eps: float
    """in world units"""
    log_unit: float
    """log of the world units in a scene unit"""
    bound: str
    """an OpacityBound, or "none" for a field without opacity residual"""
    geometry_gradient: bool
    precision: str


class FusedFunction(torch.autograd.Function):
    """(tables, visible rows, camera centres, shared weights) -> colours [M, 3], opacities [M].

    Camera centres [3] promise that no row of `visible` repeats. All tensors are float32 on one device; `visible` is
    int64.
    """

    @staticmethod
    def forward(ctx, packing: Packing, options: FieldOptions, means, latents, features_dc, opacities, visible, centers,
                *weights):  # fmt: skip
        tables = [_contiguous(table) for table in (means, latents, features_dc, opacities)]
        visible, centers = _contiguous(visible), _contiguous(centers)
        packed = torch.cat([w.reshape(-1) for w in weights] + [_zero(means.device)]).index_select(0, packing.gather)
        count = len(visible)
        colors, seen = means.new_empty(count, 3), means.new_empty(count)
        if count > 0:
            how = FORWARD[options.precision]
            forward_kernel[(_programs(how, count, means.device),)](
                *tables, visible, centers, packed, colors, seen,
                count, options.distance_eps**2, options.log_unit, options.color_scale, options.opacity_scale, SH_C0,
                D=packing.latent_dim, P=packing.width, H=packing.hidden, B=how.block,
                ONE_CENTER=centers.dim() == 1, BOUND=options.bound, KIND=KINDS[options.precision][0],
                num_warps=how.warps, num_stages=how.stages,
            )  # fmt: skip
        ctx.save_for_backward(*tables, visible, centers, packed)
        ctx.packing, ctx.options = packing, options
        return colors, seen

    @staticmethod
    @once_differentiable
    def backward(ctx, d_colors, d_opacities):
        packing, options = ctx.packing, ctx.options
        *tables, visible, centers, packed = ctx.saved_tensors
        count, rows, device = len(visible), len(tables[0]), visible.device
        one_center, wants_center = centers.dim() == 1, ctx.needs_input_grad[7] and options.geometry_gradient
        d_tables = _zero_tables(rows, packing.latent_dim, device)
        d_centers = torch.empty_like(centers) if wants_center else tables[0].new_empty(CENTER_SLOTS)
        if count > 0:
            how = BACKWARD[options.precision]
            programs = _programs(how, count, device)
            partials = tables[0].new_empty(programs, packing.size + CENTER_SLOTS)
            kind, gradient_kind = KINDS[options.precision]
            backward_kernel[(programs,)](
                *tables, visible, centers, packed,
                _contiguous(d_colors), _contiguous(d_opacities), *d_tables, d_centers, partials,
                count, options.distance_eps**2, options.log_unit, options.color_scale, options.opacity_scale, SH_C0,
                D=packing.latent_dim, P=packing.width, H=packing.hidden, B=how.block, SLOTS=partials.shape[1],
                ONE_CENTER=one_center, BOUND=options.bound, GEOMETRY=options.geometry_gradient, CENTER=wants_center,
                KIND=kind, GRADIENT_KIND=gradient_kind,
                num_warps=how.warps, num_stages=how.stages,
            )  # fmt: skip
            sums = partials.sum(dim=0)
        else:
            sums = packed.new_zeros(packing.size + CENTER_SLOTS)
        if wants_center and one_center:
            d_centers = sums[packing.size : packing.size + 3]
        flat = sums.index_select(0, packing.scatter).split([shape.numel() for shape in packing.shapes])
        d_weights = [d.view(shape) for d, shape in zip(flat, packing.shapes, strict=True)]
        d_means = d_tables[0] if options.geometry_gradient else None
        return None, None, d_means, *d_tables[1:], None, d_centers if wants_center else None, *d_weights


def probe(packing: Packing, options: FieldOptions) -> None:
    """Compile and run both kernels on one splat, for one camera; raise whatever goes wrong.

    What can go wrong shows only here: no C compiler for Triton's launcher, or less shared memory than the kernels take.
    """
    device = packing.gather.device
    with torch.inference_mode(False), torch.enable_grad():
        tables = [torch.zeros(1, n, device=device, requires_grad=True) for n in (3, packing.latent_dim, 3, 1)]
        weights = [torch.zeros(shape, device=device, requires_grad=True) for shape in packing.shapes]
        visible, center = torch.zeros(1, dtype=torch.int64, device=device), torch.ones(3, device=device)
        colors, opacities = FusedFunction.apply(packing, options, *tables, visible, center, *weights)
        (colors.sum() + opacities.sum()).backward()


def _programs(how: Launch, count: int, device: torch.device) -> int:
    """Programs to launch: all that run at once, unless there are fewer blocks."""
    if INTERPRETED.value:
        at_once = INTERPRETER_PROGRAMS
    else:
        at_once = how.programs_per_sm * _multiprocessors(device)
    return min(at_once, math.ceil(count / how.block))


def _zero_tables(rows: int, latent_dim: int, device: torch.device) -> list[Tensor]:
    """Zeros [N, 3], [N, D], [N, 3] and [N, 1], cut from one allocation so that one launch clears them.

    Each begins at a multiple of 16 bytes whatever N is: Triton compiles another kernel for pointers that do not.
    """
    padded = -(-rows // 4) * 4
    widths = (3, latent_dim, 3, 1)
    pieces = torch.zeros(padded * sum(widths), device=device).split([padded * width for width in widths])
    return [piece[: rows * width].view(rows, width) for piece, width in zip(pieces, widths, strict=True)]


def _contiguous(x: Tensor) -> Tensor:
    """x without gradient, dense."""
    return x.detach().contiguous()


_ZEROS: dict[torch.device, Tensor] = {}
_MULTIPROCESSORS: dict[torch.device, int] = {}


def _zero(device: torch.device) -> Tensor:
    """A zero [1] on `device`, made once."""
    if device not in _ZEROS:
        _ZEROS[device] = torch.zeros(1, device=device)
    return _ZEROS[device]


def _multiprocessors(device: torch.device) -> int:
    """The device's multiprocessors, asked once."""
    if device not in _MULTIPROCESSORS:
        _MULTIPROCESSORS[device] = torch.cuda.get_device_properties(device).multi_processor_count
    return _MULTIPROCESSORS[device]
