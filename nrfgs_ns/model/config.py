# SPDX-License-Identifier: Apache-2.0
"""The options of the model."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import tyro
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.densification import McmcDensification, OpacitySeen, OriginalDensification, Strategy
from nrfgs_ns.errors import InputError
from nrfgs_ns.model.retired import RETIRED

PRIOR_VIEWS = 20
"""So many training views are half of what a head needs: `few_views` trusts it by that."""
HALVING_VIEWS = 12
"""So many more training views halve `shrinkage`."""
NEGLIGIBLE = 1e-6
"""A weight of shrinkage below it is none: Adam would still make whole steps of it for splats that no view sees."""


def _model() -> type:
    from nrfgs_ns.model.model import NrfgsModel

    return NrfgsModel


@dataclass
class NrfgsModelConfig(SplatfactoModelConfig):
    """Splatfacto's options, and the appearance head's."""

    _target: type = field(default_factory=_model)
    """target class to instantiate"""
    appearance: AppearanceHeadConfig = field(default_factory=NrfConfig)
    """the appearance head: what a splat's colour and opacity are, seen from a camera"""
    view_noise: float = 0.0
    """noise on the camera centre from which the head sees each splat in training, in distances between neighbouring
    training cameras (docs/captures.md)"""
    few_views: Literal["auto", "off"] = "off"
    """auto: V different training views give the head the trust u = V / (V + 20), which divides the noise and multiplies
    the opacity residual (docs/captures.md)"""
    shrinkage: float = 0.0
    """weight in the loss of the splats' mean opacity and mean size, in percent, halved for every 12 training views
    (docs/captures.md). mcmc has its own instead"""
    warmup_steps: int | None = None
    """steps before training in which a head that starts with a residual unlearns it. None: one for each training
    view"""
    densification: Strategy = "splatfacto"
    """how splats are added and removed. splatfacto: nerfstudio's rules. original: those of 3DGS. mcmc: 3DGS-MCMC, up to
    splat_budget"""
    splat_budget: int = 1_000_000
    """mcmc: the number of splats to grow to and to keep"""
    opacity_seen_by_densification: OpacitySeen | None = None
    """opacity by which splats are pruned or moved (docs/opacity.md). base: stored. peak: largest shown since the last
    refinement. None: peak for mcmc, otherwise base"""
    keep: float = 1.0
    """share of the splats to keep after growth; those that the training views would miss least are removed
    (docs/fewer-splats.md)"""
    original: OriginalDensification = field(default_factory=OriginalDensification)
    """thresholds of the densification 'original'"""
    mcmc: McmcDensification = field(default_factory=McmcDensification)
    """constants of the densification 'mcmc'"""
    photographs: Literal["auto", "on", "off"] = "auto"
    """learn each photograph's exposure and white balance. auto: if photographs or EXIF show that they vary
    (docs/exposure.md)"""
    robust_loss: float = 0.0
    """largest share of pixels that the loss ignores, those with the largest residuals, such as passers-by
    (docs/exposure.md)"""
    # The head decides these two; they stay because nerfstudio's exporter and viewer read them from here.
    sh_degree: tyro.conf.Suppress[int] = 3
    sh_degree_interval: tyro.conf.Suppress[int] = 1000

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Be what a config.yml says; that of an older version has other options, or values that are no more."""
        options = vars(type(self)())
        state = {**options, **{name: value for name, value in state.items() if name in options}}
        state["few_views"] = "auto" if state["few_views"] == "on" else state["few_views"]
        self.__dict__.update(state)
        self.densification = RETIRED.get(self.densification, self.densification)

    def check(self) -> None:
        """Raise InputError where an option is out of range. The densification and the head check their own."""
        if not isinstance(self.appearance, AppearanceHeadConfig):
            raise InputError(
                f"pipeline.model.appearance is {self.appearance!r}, which is not the configuration of an appearance "
                "head. Use one from nrfgs_ns.appearance, such as NrfConfig or ShConfig."
            )
        for name, choices in (("few_views", ("auto", "off")), ("rasterize_mode", ("classic", "antialiased"))):
            if getattr(self, name) not in choices:
                fix = " or ".join(map(repr, choices))
                raise InputError(f"pipeline.model.{name} is {getattr(self, name)!r}; use {fix}.")
        for names, low, high, needed in (
            (("view_noise", "shrinkage", "warmup_steps"), 0, math.inf, "zero or positive"),
            (("robust_loss",), 0, 1, "at least 0 and below 1"),
            (("cull_alpha_thresh",), 0, 0.5, "at least 0 and below 0.5, since a reset is to twice as much"),
            (("refine_every", "reset_alpha_every", "resolution_schedule", "num_random"), 1, math.inf, "at least 1"),
        ):
            for name in names:
                value = getattr(self, name)
                if value is not None and not low <= value < high:
                    raise InputError(f"pipeline.model.{name} is {value}; it must be {needed}.")

    def trust(self, views: int) -> float:
        """How far so many training views trust the head, in (0, 1]."""
        return views / (views + PRIOR_VIEWS) if self.few_views == "auto" and views > 0 else 1.0

    def suited_appearance(self, views: int) -> AppearanceHeadConfig:
        """The head's configuration as so many training views, and the densification, want it."""
        head = self.appearance.trusted(self.trust(views))
        return head.for_copies() if self.densification == "mcmc" else head

    def shrinkage_weight(self, views: int) -> float:
        """What `shrinkage` is with so many training views."""
        weight = self.shrinkage / 100 * 0.5 ** (views / HALVING_VIEWS)
        return weight if weight >= NEGLIGIBLE and self.densification != "mcmc" else 0.0
