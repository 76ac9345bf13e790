# SPDX-License-Identifier: Apache-2.0
"""The registered methods: configuration only.

The methods for comparison differ from splatfacto in the appearance head alone: learning rates, schedules, densification
and steps are splatfacto's, to the number. `nrfgs` also suits the training to the capture: steps, growth, start, near
plane, and how far the views are trusted (docs/captures.md). Its two presets are ends of the trade in docs/speed.md, and
`nrfgs-harmonics` suits the training of harmonics alike.
"""

from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from nrfgs_ns.appearance.gsnb import GsnbConfig
from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.sg import SgConfig
from nrfgs_ns.appearance.sh import ShConfig
from nrfgs_ns.appearance.vdgs import VdgsConfig
from nrfgs_ns.densification import ErrorGuided
from nrfgs_ns.model.config import NrfgsModelConfig
from nrfgs_ns.start import with_methods
from nrfgs_ns.training.pace import FEWEST_STEPS, STEPS
from nrfgs_ns.training.pipeline import NrfgsPipelineConfig
from nrfgs_ns.training.progress import ProgressLineConfig
from nrfgs_ns.training.trainer_config import AVERAGED, NrfgsTrainerConfig
from nrfgs_ns.viewer.server import LocalViewerConfig

with_methods()

SUITED = {
    "densification": ErrorGuided(),
    "dense_start": "auto",
    "twin": "auto",
    "near_plane": "auto",
    "view_noise": 0.5,  # distances between neighbouring training cameras
    "shrinkage": 3.0,  # halved with every 12 training views
}
"""The model's options that suit a training to its capture, whatever the head."""


def adam(lr: float, lr_final: float | None = None, **schedule: Any) -> dict[str, Any]:
    """Adam at learning rate `lr`, decaying exponentially to `lr_final` over the training if that is given."""
    decay = ExponentialDecaySchedulerConfig(lr_final=lr_final, max_steps=STEPS, **schedule) if lr_final else None
    return {"optimizer": AdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": decay}


def method(name: str, appearance: AppearanceHeadConfig, description: str, **optimizers: Any) -> MethodSpecification:
    """Splatfacto with another appearance head, and with that head's own parameter groups beside the base colour."""
    return MethodSpecification(
        config=NrfgsTrainerConfig(
            method_name=name,
            max_num_iterations=STEPS,
            steps_per_eval_image=100,
            steps_per_eval_batch=0,
            steps_per_save=2000,
            steps_per_eval_all_images=1000,
            # The profiler's table of durations would end every command. For what is logged the host waits until the GPU
            # has nothing left to do.
            logging=LoggingConfig(profiler="none", local_writer=ProgressLineConfig(), steps_per_log=100),
            machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
            pipeline=NrfgsPipelineConfig(model=NrfgsModelConfig(appearance=appearance)),
            optimizers={
                "means": adam(1.6e-4, lr_final=1.6e-6),
                "scales": adam(0.005),
                "quats": adam(0.001),
                "opacities": adam(0.05),
                "features_dc": adam(0.0025),
                **optimizers,
                "camera_opt": adam(1e-4, lr_final=5e-7, warmup_steps=1000, lr_pre_warmup=0),
                "photograph": adam(5e-3, lr_final=1e-4, warmup_steps=500, lr_pre_warmup=0),
            },
            viewer=LocalViewerConfig(num_rays_per_chunk=1 << 15),
            vis="viewer",
        ),
        description=description,
    )


def preset(name: str, of: MethodSpecification, description: str, model: dict[str, Any], **trainer: Any):
    """A method with other options of its model and of its trainer."""
    pipeline = replace(of.config.pipeline, model=replace(of.config.pipeline.model, **model))
    return MethodSpecification(
        config=replace(deepcopy(of.config), method_name=name, pipeline=deepcopy(pipeline), **trainer),
        description=description,
    )


nrfgs = preset(
    "nrfgs",
    method("nrfgs", NrfConfig(), "", latents=adam(0.0025), field=adam(5e-3, lr_final=5e-4)),
    "Gaussian splatting with a neural residual field for view-dependent colour and opacity.",
    model={**SUITED, "few_views": "auto"},
    max_num_iterations=0,
)

nrfgs_fast = preset(
    "nrfgs-fast",
    nrfgs,
    "nrfgs in 10,000 steps, for a first result (docs/speed.md).",
    model={"twin": "off"},
    max_num_iterations=FEWEST_STEPS,
    schedule_steps=STEPS,
    average_steps=AVERAGED,
)

nrfgs_best = preset(
    "nrfgs-best",
    nrfgs,
    "nrfgs in 30,000 steps with a finer threshold: more splats, time and detail (docs/speed.md).",
    model={"densification": ErrorGuided(threshold=0.0016)},
    max_num_iterations=STEPS,
    average_steps=AVERAGED,
)

nrfgs_sh = method(
    "nrfgs-sh",
    ShConfig(),
    "For comparison: spherical harmonics, 3DGS as in splatfacto.",
    features_rest=adam(0.0025 / 20),
)

nrfgs_harmonics = preset(
    "nrfgs-harmonics",
    nrfgs_sh,
    "nrfgs with spherical harmonics instead of the field: for few photographs (docs/captures.md).",
    model=SUITED,
    max_num_iterations=0,
)

nrfgs_vdgs = method(
    "nrfgs-vdgs",
    VdgsConfig(),
    "For comparison: VDGS, spherical harmonics and opacity that depends on the view.",
    features_rest=adam(0.0025 / 20),
    field=adam(1e-3),
)

nrfgs_gsnb = method(
    "nrfgs-gsnb",
    GsnbConfig(),
    "For comparison: GSNB, spherical harmonics and a learnt basis.",
    features_rest=adam(0.0025 / 20),
    # AdamW as its reference has it, with torch's own eps and decay.
    field={"optimizer": AdamOptimizerConfig(_target=torch.optim.AdamW, lr=1e-3, weight_decay=0.01), "scheduler": None},
)

nrfgs_sg = method(
    "nrfgs-sg",
    SgConfig(),
    "For comparison: SG, three spherical Gaussians on a base colour.",
    sg_axes=adam(0.0025),
    sg_sharpness=adam(0.0025),
    sg_colors=adam(0.0025),
)
