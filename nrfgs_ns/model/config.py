# SPDX-License-Identifier: Apache-2.0
"""The options of the model."""

import math
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Literal

import tyro
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.models.base_model import ModelConfig

from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.densification import DensificationChoice, Splatfacto
from nrfgs_ns.errors import require

PRIOR_VIEWS = 20
"""Training views with which the trust in the head, by `few_views`, is one half."""
EPSILON = math.ulp(1.0)


@dataclass
class NrfgsModelConfig(ModelConfig):
    """Options of the model: this package's own, then those of splatfacto that are not the densification's."""

    _target: type = field(default_factory=lambda: resolve_name("nrfgs_ns.model.model:NrfgsModel"))  # it imports this
    appearance: AppearanceHeadConfig = field(default_factory=NrfConfig)
    """the appearance head: what a splat's colour and opacity are, seen from a camera"""
    view_noise: float = 0.0
    """noise on the camera centre that the head sees in training, in distances between neighbouring training cameras
    (docs/captures.md)"""
    few_views: Literal["auto", "off"] = "off"
    """auto: the fewer the training views, the more noise and the less opacity residual (docs/captures.md)"""
    shrinkage: float = 0.0
    """weight in the loss of the splats' mean opacity and mean size, in percent, halved for every 12 training views
    (docs/captures.md)"""
    dense_start: Literal["auto", "off"] = "off"
    """auto: start with points from the photographs, too, the more the fewer there are (docs/captures.md)"""
    twin: Literal["auto", "on", "off"] = "off"
    """train a second model beside the first, with which it must agree between the cameras. auto: on one GPU, where
    views are few (docs/captures.md)"""
    depth: str = ""
    """weight,every,shape,until: trial of depths from photographs"""
    near_plane: Literal["auto", "off"] = "off"
    """auto: draw nothing nearer than half the depth of the capture's nearest points (docs/captures.md). off: nothing
    nearer than 0.01 scene units, as in splatfacto"""
    warmup_steps: int | None = None
    """steps before training in which a head that starts with a residual unlearns it. None: one for each view"""
    densification: DensificationChoice = field(default_factory=Splatfacto)
    """how splats are added and removed: error-guided (where the error is), splatfacto, original (3DGS) or mcmc, with
    options of its own, as in mcmc,budget=150000. Those left out have its defaults, not a preset's (docs/options.md)"""
    photographs: Literal["auto", "on", "off"] = "auto"
    """learn each photograph's exposure and white balance. auto: if they vary (docs/exposure.md)"""
    robust_loss: float = 0.0
    """largest share of pixels that the loss ignores: those with the largest residuals (docs/exposure.md)"""
    resolution_schedule: int = 3000
    """steps after which the resolution doubles"""
    num_downscales: int = 2
    """the training begins at 1 / 2^d of the images' resolution"""
    background_color: Literal["random", "black", "white"] = "random"
    """behind the splats in training"""
    random_init: bool = False
    """start from random points instead of the capture's"""
    num_random: int = 50000
    """number of random points"""
    random_scale: float = 10.0
    """side of the cube in which random points lie, in scene units"""
    ssim_lambda: float = 0.2
    """weight of SSIM in the loss; that of L1 is 1 - this"""
    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    """classic: splats are blurred by 0.3 pixels. antialiased: and dimmed for it (Mip-Splatting)"""
    camera_optimizer: CameraOptimizerConfig = field(default_factory=lambda: CameraOptimizerConfig(mode="off"))
    """learn the cameras' poses"""
    # The head decides this one; nerfstudio's exporter reads it here.
    sh_degree: tyro.conf.Suppress[int] = 3

    def check(self) -> None:
        """Raise InputError where a number is out of range. The head checks its own options when it is built; types and
        choices are checked where a configuration is read (`training/config_file.py`)."""
        self.densification.check()
        for names, low, high, needed in (
            ("view_noise shrinkage warmup_steps num_downscales", 0, math.inf, "zero or positive"),
            ("ssim_lambda", 0, 1 + EPSILON, "from 0 to 1"),
            ("robust_loss", 0, 1, "at least 0 and below 1"),
            ("random_scale", EPSILON, math.inf, "positive"),
            ("resolution_schedule num_random", 1, math.inf, "at least 1"),
        ):
            for name in names.split():
                value = getattr(self, name)
                require(value is None or low <= value < high, f"pipeline.model.{name}", value, needed)

    def trust(self, views: int) -> float:
        """Trust in the head with this number of training views, in (0, 1]."""
        return views / (views + PRIOR_VIEWS) if self.few_views == "auto" and views > 0 else 1.0

    def suited_appearance(self, views: int) -> AppearanceHeadConfig:
        """The head's configuration for this number of training views, and for the densification."""
        head = self.appearance.trusted(self.trust(views))
        return head.for_copies() if self.densification.copies_splats else head
