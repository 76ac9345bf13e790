# SPDX-License-Identifier: Apache-2.0
"""The laboratory's methods: splatfacto's training, as the methods for comparison in `nrfgs_ns/method_config.py`."""

from nrfgs_lab.heads.deferred import DeferredConfig
from nrfgs_lab.heads.latent_spec import LatentSpecConfig
from nrfgs_ns.method_config import adam, method

deferred = method(
    "nrfgs-deferred",
    DeferredConfig(),
    "For comparison: features of splats composited, and a network for each pixel (after Neural Harmonic Textures).",
    features=adam(0.015, lr_final=0.0015),
    field=adam(6.8e-4, lr_final=6.8e-5),
)

latent_spec = method(
    "nrfgs-latent-spec",
    LatentSpecConfig(),
    "For comparison: features of splats composited, and convolutions to two images (after Latent-SpecGS).",
    features=adam(0.0025),
    field=adam(1e-3, lr_final=1e-4),
)
