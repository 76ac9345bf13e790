# SPDX-License-Identifier: Apache-2.0
"""The field in two Triton kernels, one forward and one backward; PyTorch's twin is `nrf.py`.

`packing.py` lays out weights and features, `kernels.py` computes with the building blocks of `tiles.py`, `launch.py`
makes a differentiable function of it, and this file decides whether it can run. Triton is imported only then: machines
without CUDA lack it. With TRITON_INTERPRET=1 the same kernels run in Triton's interpreter on the CPU, for tests.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.fused.packing import Packing, pack
from nrfgs_ns.errors import InputError
from nrfgs_ns.kernels.trial import Gate

TABLES = "means", "latents", "features_dc", "opacities"
"""Names of the tables that the kernels read."""
MAX_WIDTH = 64
"""Largest P (packing.py)."""
MAX_WEIGHTS = 128 * 128
"""Most numbers in the padded first layer: registers keep their gradients, shared memory the layer."""


class FusedField:
    """The fused twin of one field: shares its weights, and has no state of its own but index maps.

    Args:
        config: the field's NrfConfig.
        branches: low and high, or the only one.
    """

    def __init__(self, config, branches: Sequence[nn.Sequential]):
        self.config = config
        self.layers = [layer for branch in branches for layer in branch if isinstance(layer, nn.Linear)]
        self.on_cpu = pack(config.latent_dim, config.num_bands, config.use_distance, branches)
        self.ready = Gate("The field")

    def takes(self, splats: Mapping[str, Tensor]) -> bool:
        """Whether the kernels compute this call; InputError if the configuration demands them, and they cannot."""
        if self.config.implementation == "torch":
            return False
        reason = self._why_not(splats)
        if reason is not None and self.config.implementation == "fused":
            option = "pipeline.model.appearance.implementation"
            raise InputError(f"{option} is 'fused', but {reason}. Set --{option} auto or torch.")
        return reason is None

    def _why_not(self, splats: Mapping[str, Tensor]) -> str | None:
        """Why the kernels cannot compute on these splats, or None."""
        device = splats["means"].device
        interpreted = self.config.implementation == "fused" and os.environ.get("TRITON_INTERPRET") == "1"
        if device.type != "cuda" and not interpreted:
            return f"the splats are on {device.type}, and the kernels run on CUDA"
        if any(splats[name].dtype != torch.float32 for name in TABLES):
            return "the splats are not float32"
        ready = self._ready_on(device)
        return ready if isinstance(ready, str) else None

    def try_on(self, device: torch.device) -> None:
        """Find out whether the kernels run on a CUDA device."""
        if self.config.implementation != "torch":
            self._ready_on(device)

    def __call__(
        self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor, scene_unit: float
    ) -> tuple[Tensor, Tensor]:
        """Colours [M, 3] and opacities [M]: see AppearanceHead.forward, after `takes` said yes."""
        from nrfgs_ns.appearance.fused.launch import FieldOptions, FusedFunction

        weights = [weight for layer in self.layers for weight in (layer.weight, layer.bias)]
        tables = [splats[name] for name in TABLES]
        ready, options = self._ready_on(visible.device), FieldOptions.of(self.config, scene_unit)
        return FusedFunction.apply(*ready, options, *tables, visible, camera_centers, *weights)

    def _ready_on(self, device: torch.device) -> tuple[Packing, Any] | str:
        """Index maps and launches on `device`, or why there are none: tried and reported once."""
        quiet = self.config.implementation != "auto"
        return self.ready.find((device, self.config.precision), device, lambda: self._prepare(device), quiet)

    def _prepare(self, device: torch.device) -> tuple[Packing, Any] | str:
        width, hidden = self.on_cpu.width, self.on_cpu.hidden
        if width > MAX_WIDTH or 2 * width * hidden > MAX_WEIGHTS:
            return (
                f"its sizes are beyond the kernels': padded to powers of two, {width} latents or features (at most "
                f"{MAX_WIDTH}) and {2 * width} x {hidden} weights of the first layer (at most {MAX_WEIGHTS})"
            )
        from nrfgs_ns.appearance.fused.launch import FieldOptions, first_that_runs

        packing = self.on_cpu.to(device)
        return packing, first_that_runs(packing, FieldOptions.of(self.config))
