# SPDX-License-Identifier: Apache-2.0
"""The field and VDGS with networks that have no biases, as tiny-cuda-nn builds them (docs/bench/deviations.yaml)."""

from torch import nn

from nrfgs_ns.appearance.nrf import NeuralResidualField, NrfConfig
from nrfgs_ns.appearance.vdgs import VdgsConfig, ViewDirectionFactors
from nrfgs_ns.method_config import adam, method


def field_without_biases(config: NrfConfig) -> NeuralResidualField:
    return without_biases(NeuralResidualField(config))


def factors_without_biases(config: VdgsConfig) -> ViewDirectionFactors:
    return without_biases(ViewDirectionFactors(config))


def without_biases(head):
    """The head, its linear layers left with their weights alone."""
    for layer in head.modules():
        if isinstance(layer, nn.Linear):
            layer.bias = None
    return head


# By PyTorch: the fused kernels have biases.
nrf = method(
    "nrfgs-no-biases",
    NrfConfig(_target=field_without_biases, implementation="torch"),
    "For comparison: NRF-GS without biases.",
    latents=adam(0.0025),
    field=adam(5e-3, lr_final=5e-4),
)
vdgs = method(
    "nrfgs-vdgs-no-biases",
    VdgsConfig(_target=factors_without_biases),
    "For comparison: VDGS without biases.",
    features_rest=adam(0.0025 / 20),
    field=adam(1e-3),
)
