# SPDX-License-Identifier: Apache-2.0
"""The field in two Triton kernels, one forward and one backward; its twin in PyTorch is `nrf.py`.

`packing.py` lays out weights and features, `kernels.py` computes with the building blocks of `tiles.py`, `launch.py`
makes a differentiable function of both kernels, and this file decides whether they can run. Triton is imported only if
they can: machines without CUDA lack it. With TRITON_INTERPRET=1 the kernels run in Triton's interpreter on the CPU, for
tests.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.fused.packing import Packing, pack
from nrfgs_ns.errors import InputError
from nrfgs_ns.kernels.trial import Gate

TABLES = ("means", "latents", "features_dc", "opacities")
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
        self.packing = pack(config.latent_dim, config.num_bands, config.use_distance, branches)
        self.gate = Gate("The field")

    def takes(self, splats: Mapping[str, Tensor]) -> bool:
        """Whether the kernels compute this call; InputError if the configuration demands them, and they cannot."""
        if self.config.implementation == "torch":
            return False
        reason = self._obstacle(splats)
        if reason is not None and self.config.implementation == "fused":
            option = "pipeline.model.appearance.implementation"
            raise InputError(f"{option} is 'fused', but {reason}. Set --{option} auto or torch.")
        return reason is None

    def _obstacle(self, splats: Mapping[str, Tensor]) -> str | None:
        """Why the kernels cannot compute on these splats, or None."""
        device = splats["means"].device
        interpreted = self.config.implementation == "fused" and os.environ.get("TRITON_INTERPRET") == "1"
        if device.type != "cuda" and not interpreted:
            return f"the splats are on {device.type}, and the kernels run on CUDA"
        if any(splats[name].dtype != torch.float32 for name in TABLES):
            return "the splats are not float32"
        prepared = self._prepared_on(device)
        return prepared if isinstance(prepared, str) else None

    def try_kernels(self, device: torch.device) -> None:
        """Try the kernels on a CUDA device, unless the configuration asks for PyTorch."""
        if self.config.implementation != "torch":
            self._prepared_on(device)

    def __call__(
        self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor, scene_unit: float
    ) -> tuple[Tensor, Tensor]:
        """Colours [M, 3] and opacities [M] as `AppearanceHead.forward`'s, where `takes` is true."""
        from nrfgs_ns.appearance.fused.launch import FusedFunction

        weights = [weight for layer in self.layers for weight in (layer.weight, layer.bias)]
        tables = [splats[name] for name in TABLES]
        packing, launches = self._prepared_on(visible.device)
        options = self.config, scene_unit
        return FusedFunction.apply(packing, launches, *options, *tables, visible, camera_centers, *weights)

    def _prepared_on(self, device: torch.device) -> tuple[Packing, Any] | str:
        """Index maps and launches on `device`, or the reason why there are none; tried and reported once."""
        quiet = self.config.implementation != "auto"
        return self.gate.find((device, self.config.precision), device, lambda: self._prepare(device), quiet)

    def _prepare(self, device: torch.device) -> tuple[Packing, Any] | str:
        width, hidden = self.packing.width, self.packing.hidden
        if width > MAX_WIDTH or 2 * width * hidden > MAX_WEIGHTS:
            return (
                f"its sizes are beyond the kernels': padded to powers of two, {width} latents or features (at most "
                f"{MAX_WIDTH}) and {2 * width} x {hidden} weights of the first layer (at most {MAX_WEIGHTS})"
            )
        from nrfgs_ns.appearance.fused.launch import first_that_runs

        packing = self.packing.to(device)
        return packing, first_that_runs(packing, self.config)
