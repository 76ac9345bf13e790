# SPDX-License-Identifier: Apache-2.0
"""The field in two Triton kernels, one forward and one backward; PyTorch's twin is `nrf.py`.

`packing.py` lays out weights and features, `kernels.py` computes with the building blocks of `tiles.py`, `launch.py`
makes a differentiable function of it, and this file decides whether it can run. Triton is imported only then: machines
without CUDA lack it. With TRITON_INTERPRET=1 the same kernels run in Triton's interpreter on the CPU, for tests.
"""

import math
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.field import DIFFUSE
from nrfgs_ns.appearance.fused.packing import Packing, pack
from nrfgs_ns.errors import InputError
from nrfgs_ns.kernels.trial import Gate

if TYPE_CHECKING:  # imports Triton
    from nrfgs_ns.appearance.fused.launch import FieldOptions, Launches

MAX_WIDTH = 64
"""Largest P (packing.py)."""
MAX_WEIGHTS = 128 * 128
"""Most numbers in the padded first layer: registers keep their gradients, shared memory the layer."""


class FusedField:
    """The fused twin of one field: shares its weights, and has no state of its own but index maps.

    Args:
        config: the field's NrfConfig.
        low, high: its branches; high is None if there is only one.
    """

    def __init__(self, config, low: nn.Sequential, high: nn.Sequential | None):
        self.config = config
        branches = [branch for branch in (low, high) if branch is not None]
        self.layers = [layer for branch in branches for layer in branch if isinstance(layer, nn.Linear)]
        self.on_cpu = pack(config.latent_dim, config.num_bands, config.use_distance, low, high)
        # By device, precision, and whether some splats are diffuse.
        self.ready = Gate("The field")

    def takes(self, splats: Mapping[str, Tensor], camera_centers: Tensor) -> bool:
        """Whether the kernels compute this call.

        Raises:
            InputError: the configuration demands them, and they cannot.
        """
        if self.config.implementation == "torch":
            return False
        reason = self._why_not(splats, camera_centers)
        if reason is not None and self.config.implementation == "fused":
            raise InputError(
                f"pipeline.model.appearance.implementation is 'fused', but {reason}. "
                "Set --pipeline.model.appearance.implementation auto or torch."
            )
        return reason is None

    def try_on(self, device: torch.device) -> None:
        """Find out whether the kernels run on a CUDA device."""
        if self.config.implementation != "torch":
            self._ready_on(device)

    def __call__(
        self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor, scene_unit: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Colours [M, 3] and opacities [M]: see AppearanceHead.forward, after `takes` said yes."""
        from nrfgs_ns.appearance.fused.launch import FusedFunction, evaluate, packed_weights

        weights = [weight for layer in self.layers for weight in (layer.weight, layer.bias)]
        tables = [splats[name] for name in ("means", "latents", "features_dc", "opacities")]
        diffuse = splats.get(DIFFUSE)
        ready = self._ready_on(visible.device, diffuse is not None)
        options = self._options(scene_unit)
        if not torch.is_grad_enabled():
            packing, launches = ready
            whole = [tensor.detach().contiguous() for tensor in (*tables, visible, camera_centers)]
            packed = packed_weights(packing, weights)
            return evaluate(packing, launches.forward, options, whole[:4], diffuse, *whole[4:], packed)[:2]
        return FusedFunction.apply(*ready, options, *tables, diffuse, visible, camera_centers, *weights)

    def _why_not(self, splats: Mapping[str, Tensor], camera_centers: Tensor) -> str | None:
        """Why the kernels cannot compute this call, or None."""
        device = splats["means"].device
        interpreted = os.environ.get("TRITON_INTERPRET") == "1"
        demanded = self.config.implementation == "fused"
        if device.type != "cuda" and not (interpreted and demanded):
            return f"the splats are on {device.type}, and the kernels run on CUDA"
        weight = self.layers[0].weight
        for name, tensor in (*splats.items(), ("camera_centers", camera_centers), ("shared weights", weight)):
            taken = torch.bool if name == DIFFUSE else torch.float32
            if tensor.dtype != taken:
                own, needed = (str(dtype).removeprefix("torch.") for dtype in (tensor.dtype, taken))
                return f"{name} is {own}, and the kernels take {needed}"
            if tensor.device != device:
                return f"{name} is on {tensor.device}, and means on {device}"
        ready = self._ready_on(device, DIFFUSE in splats)
        return ready if isinstance(ready, str) else None

    def _ready_on(self, device: torch.device, some_diffuse: bool = False) -> "tuple[Packing, Launches] | str":
        """The result of `_prepare` on `device`: tried and reported once."""
        key = device, self.config.precision, some_diffuse
        quiet = self.config.implementation != "auto"
        return self.ready.find(key, device, lambda: self._prepare(device, some_diffuse), quiet)

    def _prepare(self, device: torch.device, some_diffuse: bool) -> "tuple[Packing, Launches] | str":
        """Index maps and launches on `device`, or why there are none."""
        width, hidden = self.on_cpu.width, self.on_cpu.hidden
        if width > MAX_WIDTH or 2 * width * hidden > MAX_WEIGHTS:
            return (
                f"its sizes are beyond the kernels': padded to powers of two, {width} latents or features (at most "
                f"{MAX_WIDTH}) and {2 * width} x {hidden} weights of the first layer (at most {MAX_WEIGHTS})"
            )
        from nrfgs_ns.appearance.fused.launch import first_that_runs

        packing = self.on_cpu.to(device)
        return packing, first_that_runs(packing, self._options(), some_diffuse)

    def _options(self, scene_unit: float = 1.0) -> "FieldOptions":
        from nrfgs_ns.appearance.fused.launch import FieldOptions

        config = self.config
        return FieldOptions(
            color_scale=config.color_scale,
            opacity_scale=config.opacity_scale,
            distance_eps=config.distance_eps * scene_unit,
            log_unit=math.log(scene_unit),
            bound=config.bound if config.opacity_residual else "none",
            precision=config.precision,
        )
