# SPDX-License-Identifier: Apache-2.0
"""Both kernels as one differentiable function of tables, camera centres and shared weights.

A training step of a small scene is bound by the host, so launches are few: two to pack the weights, one forward, four
to zero the tables' gradients unless every splat is visible, one backward, two to sum and unpack the weights' gradients.
"""

import functools
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nrfgs_ns.appearance.fused.kernels import backward_kernel, forward_kernel
from nrfgs_ns.appearance.fused.packing import CENTER_SLOTS, Packing
from nrfgs_ns.appearance.fused.tiles import INTERPRETED
from nrfgs_ns.appearance.head import SH_C0


class Launch(NamedTuple):
    """How a kernel is compiled and launched."""

    block: int  # visible splats that a program takes at once
    warps: int  # of a program
    stages: int  # software pipelining of the loop over blocks; 1: none
    programs_per_sm: int  # a program walks over many blocks
    columns: int  # of W2 for the tensor cores: 8, or 16 with zeros behind; then d_W1 is X^T d_pre, not d_pre^T X
    registers: int | None = None  # most of a thread, for up to 128 hidden units; None leaves them to the compiler

    def options(self, hidden: int) -> dict[str, int]:
        """Options of Triton's compiler, for H hidden units.

        Four warps keep the activations of 64 splats in H / 2 registers of a thread: more than 128 units do not fit
        where registers are few. Triton must be asked for fused multiply-add from 3.10 on.
        """
        options = {"num_warps": self.warps, "num_stages": self.stages, "enable_fp_fusion": True}
        return options if self.registers is None or hidden > 128 else {**options, "maxnreg": self.registers}


class Launches(NamedTuple):
    """How both kernels are launched."""

    forward: Launch
    backward: Launch


KINDS = {"fp32": ("tf32x3", "tf32x3"), "tf32": ("tf32", "tf32"), "bf16": ("bf16", "bf16"), "fp16": ("fp16", "bf16")}
"""Kinds of products, without and with gradients among the factors, for each NrfConfig.precision.

float32 is three tf32 products on the tensor cores, many times faster than float32 multiply-add. Gradients are never
fp16: a loss that is a mean over pixels makes them as small as 1e-10, below what fp16 holds, and scaling each tile would
cost a reduction. bf16 has float32's range; its rounding is unbiased and averages out over the splats.
"""

# From times on an H200 and the compiler's account of registers and shared memory. A tensor core's tile has 64 rows.
# Forward, 128 registers let four programs of 4 warps run at once (65,536 a multiprocessor). Backward, the weights'
# gradients and the activations fill all 255 that a thread can have, so that 8 warps run at once: two programs of 64
# splats took 0.25 ms for a million, one of 128 took 0.29. With tf32 the compiler has no layout for d_pre^T X. float32's
# products take 208 KB of shared memory at 32 splats, of 227 KB on an H200; the half precisions' second way 63 KB, of
# 99 KB on a GeForce.
HALF_PRECISION = (
    Launches(
        forward=Launch(block=64, warps=4, stages=3, programs_per_sm=4, columns=8, registers=128),
        backward=Launch(block=64, warps=4, stages=3, programs_per_sm=2, columns=8),
    ),
    Launches(
        forward=Launch(block=64, warps=4, stages=1, programs_per_sm=3, columns=8),
        backward=Launch(block=64, warps=4, stages=1, programs_per_sm=2, columns=8),
    ),
)
LAUNCHES: dict[str, tuple[Launches, ...]] = {
    "fp32": (
        Launches(
            forward=Launch(block=64, warps=4, stages=3, programs_per_sm=2, columns=16),
            backward=Launch(block=32, warps=8, stages=1, programs_per_sm=1, columns=16),
        ),
    ),
    "tf32": (
        Launches(
            forward=Launch(block=64, warps=4, stages=3, programs_per_sm=3, columns=16),
            backward=Launch(block=128, warps=8, stages=1, programs_per_sm=1, columns=16),
        ),
    ),
    "bf16": HALF_PRECISION,
    "fp16": HALF_PRECISION,
}
"""For each NrfConfig.precision, fastest first: a field takes the first that its device can run at its sizes."""
INTERPRETER_PROGRAMS = 2
"""Programs in Triton's interpreter: as few as show that programs share the work."""


class FusedFunction(torch.autograd.Function):
    """(NrfConfig, tables, visible rows, camera centres, shared weights) -> colours [M, 3], opacities [M].

    Camera centres [3] promise that no row of `visible` repeats. All tensors are float32 on one device, `visible` int64.
    """

    @staticmethod
    def forward(ctx, packing: Packing, launches: Launches, config, scene_unit: float, means, latents, features_dc,
                opacities, visible, centers, *weights):  # fmt: skip
        tables = [_contiguous(table) for table in (means, latents, features_dc, opacities)]
        visible, centers = _contiguous(visible), _contiguous(centers)
        flat = [weight.detach().reshape(-1) for weight in weights]
        packed = torch.cat([*flat, _zero(visible.device)]).index_select(0, packing.gather)  # as the kernels read them
        launch = launches.forward
        count = len(visible)
        outputs = packed.new_empty(count, 3), packed.new_empty(count)
        eps_squared = (config.distance_eps * scene_unit) ** 2
        scalars = eps_squared, math.log(scene_unit), config.color_scale, config.opacity_scale, SH_C0
        if count > 0:
            forward_kernel[(_programs(launch, count, visible.device),)](
                *tables, visible, centers, packed, *outputs,
                count, *scalars, **_constants(packing, launch, config, centers.dim() == 1),
            )  # fmt: skip
        ctx.save_for_backward(*tables, visible, centers, packed)
        ctx.packing, ctx.launch, ctx.config, ctx.scalars = packing, launches.backward, config, scalars
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, d_colors, d_opacities):
        packing, launch, config = ctx.packing, ctx.launch, ctx.config
        *tables, visible, centers, packed = ctx.saved_tensors
        count = len(visible)
        one_center, wants_center = centers.dim() == 1, ctx.needs_input_grad[9]  # of forward's `centers`
        # Without zeros only where the kernel writes each row, once.
        each_row_once = one_center and count == len(tables[0])
        d_tables = [torch.empty_like(table) if each_row_once else torch.zeros_like(table) for table in tables]
        d_centers = torch.empty_like(centers) if wants_center else tables[0].new_empty(CENTER_SLOTS)
        if count > 0:
            programs = _programs(launch, count, visible.device)
            partials = tables[0].new_empty(programs, len(packing.gather) + CENTER_SLOTS)
            backward_kernel[(programs,)](
                *tables, visible, centers, packed,
                _contiguous(d_colors), _contiguous(d_opacities), *d_tables, d_centers, partials,
                count, *ctx.scalars, SLOTS=partials.shape[1], CENTER=wants_center,
                GRADIENT_KIND=KINDS[config.precision][1], **_constants(packing, launch, config, one_center),
            )  # fmt: skip
            sums = partials.sum(dim=0)
        else:
            sums = packed.new_zeros(len(packing.gather) + CENTER_SLOTS)
        if wants_center and one_center:
            d_centers = sums[len(packing.gather) : len(packing.gather) + 3]
        flat = sums.index_select(0, packing.scatter).split([shape.numel() for shape in packing.shapes])
        d_weights = [d.view(shape) for d, shape in zip(flat, packing.shapes, strict=True)]
        return None, None, None, None, *d_tables, None, d_centers if wants_center else None, *d_weights


def _constants(packing: Packing, launch: Launch, config, one_center: bool) -> dict[str, Any]:
    """Constants of both kernels, and options of Triton's compiler."""
    return {
        "D": packing.latent_dim,
        "P": packing.width,
        "H": packing.hidden,
        "BANDS": packing.num_bands,
        "B": launch.block,
        "COLUMNS": launch.columns,
        "ONE_CENTER": one_center,
        "BOUND": config.bound,
        "KIND": KINDS[config.precision][0],
        **launch.options(packing.hidden),
    }


def first_that_runs(packing: Packing, config) -> Launches:
    """The fastest launches of an NrfConfig that this device can run at these sizes; else raise what goes wrong.

    A missing C compiler and a lack of shared memory show only here. Out-of-memory is re-raised: otherwise a slower
    launch would be kept for good.
    """
    for launches in LAUNCHES[config.precision]:
        try:
            probe(packing, launches, config)
            return launches
        except torch.OutOfMemoryError:
            raise
        except Exception as error:
            reason = error
    raise reason


def probe(packing: Packing, launches: Launches, config) -> None:
    """Compile and run both kernels on one splat, for one camera; raise whatever goes wrong."""
    device = packing.gather.device
    tables = [torch.zeros(1, n, device=device, requires_grad=True) for n in (3, packing.latent_dim, 3, 1)]
    weights = [torch.zeros(shape, device=device, requires_grad=True) for shape in packing.shapes]
    visible, center = torch.zeros(1, dtype=torch.int64, device=device), torch.ones(3, device=device)
    outputs = FusedFunction.apply(packing, launches, config, 1.0, *tables, visible, center, *weights)
    sum(output.sum() for output in outputs).backward()


def _programs(launch: Launch, count: int, device: torch.device) -> int:
    """Programs to launch: all that run at once, unless there are fewer blocks."""
    at_once = INTERPRETER_PROGRAMS if INTERPRETED.value else launch.programs_per_sm * _multiprocessors(device)
    return min(at_once, math.ceil(count / launch.block))


def _contiguous(x: Tensor) -> Tensor:
    """A dense tensor without gradient."""
    return x.detach().contiguous()


@functools.cache
def _zero(device: torch.device) -> Tensor:
    return torch.zeros(1, device=device)


@functools.cache
def _multiprocessors(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count
