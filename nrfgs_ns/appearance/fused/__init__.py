# SPDX-License-Identifier: Apache-2.0
"""The field in two Triton kernels, one forward and one backward; its twin in PyTorch is `nrf.py`.

`packing.py` lays out weights and features, `kernels.py` computes with the building blocks of `tiles.py`, `launch.py`
makes a differentiable function of both kernels, and this file decides whether they can run. Triton is imported only if
they can: machines without CUDA lack it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nrfgs_ns.appearance.fused.packing import Packing, pack
from nrfgs_ns.kernels.trial import tried_once

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
        self.prepared_on = tried_once("The field")(self._prepare)

    def takes(self, splats: Mapping[str, Tensor]) -> bool:
        """Whether the kernels compute on these splats."""
        device = splats["means"].device
        wanted = self.config.implementation != "torch" and device.type == "cuda"
        float32 = all(splats[name].dtype == torch.float32 for name in TABLES)
        return wanted and float32 and self.prepared_on(device) is not None

    def __call__(
        self, splats: Mapping[str, Tensor], visible: Tensor, camera_centers: Tensor, scene_unit: float
    ) -> tuple[Tensor, Tensor]:
        """Colours [M, 3] and opacities [M] as `AppearanceHead.forward`'s, where `takes` is true."""
        from nrfgs_ns.appearance.fused.launch import FusedFunction

        weights = [weight for layer in self.layers for weight in (layer.weight, layer.bias)]
        tables = [splats[name] for name in TABLES]
        packing, launches = self.prepared_on(visible.device)
        options = self.config, scene_unit
        return FusedFunction.apply(packing, launches, *options, *tables, visible, camera_centers, *weights)

    def _prepare(self, device: torch.device) -> tuple[Packing, Any]:
        """Index maps and launches on `device`."""
        width, hidden = self.packing.width, self.packing.hidden
        if width > MAX_WIDTH or 2 * width * hidden > MAX_WEIGHTS:
            raise ValueError(
                f"its sizes are beyond the kernels': padded to powers of two, {width} latents or features (at most "
                f"{MAX_WIDTH}) and {2 * width} x {hidden} weights of the first layer (at most {MAX_WEIGHTS})"
            )
        from nrfgs_ns.appearance.fused.launch import first_that_runs

        packing = self.packing.to(device)
        return packing, first_that_runs(packing, self.config)
