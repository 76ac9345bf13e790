# SPDX-License-Identifier: Apache-2.0
"""The options of the model."""

from dataclasses import dataclass, field
from typing import Any, Literal

import tyro
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from nrfgs_ns.appearance.head import AppearanceHeadConfig
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.densification import McmcDensification, OpacitySeen, OriginalDensification, Strategy
from nrfgs_ns.errors import InputError
from nrfgs_ns.image.photograph import Part
from nrfgs_ns.model.retired import RETIRED

PRIOR_VIEWS = 20
"""So many training views are half of what a head needs: `few_views` trusts it by that."""


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
    """in training the head sees each splat from a camera centre moved by noise this many times as long as neighbouring
    training cameras are apart (docs/captures.md)"""
    head_from: float = 0.0
    """share of the training after which the head is asked and learns. Until then splats have their base colours and
    opacities"""
    few_views: Literal["auto", "off"] = "off"
    """auto: V training views trust the head with V / (V + 20), by which view_noise is longer and its opacity residual
    smaller (docs/captures.md)"""
    shrinkage: float = 0.0
    """weight, in the loss, of the mean opacity and of the mean standard deviation in scene units, divided by the square
    of the number of training views: what few views need becomes faint and small. mcmc has its own instead
    (docs/captures.md)"""
    warmup_steps: int | None = None
    """steps before training in which a head that adds something at its start learns to add nothing. None: one for each
    training view"""
    warmup_lr: float = 1e-3
    """learning rate of the warm-up's Adam"""
    densification: Strategy = "splatfacto"
    """how splats come and go. splatfacto: nerfstudio's rules. original: those of 3DGS. mcmc: 3DGS-MCMC, up to
    splat_budget"""
    splat_budget: int = 1_000_000
    """mcmc: the number of splats that it grows to and keeps"""
    opacity_seen_by_densification: OpacitySeen | None = None
    """which opacity makes a splat die. base: the stored one. peak: the largest that a view since the last refinement
    would show. None: peak for mcmc, base for the others"""
    keep: float = 1.0
    """share of the splats that is left once growth has ended, at stop_split_at: those go, in six rounds, that the
    training views would miss least (docs/fewer-splats.md). 1: all"""
    original: OriginalDensification = field(default_factory=OriginalDensification)
    """thresholds of the densification 'original'"""
    mcmc: McmcDensification = field(default_factory=McmcDensification)
    """constants of the densification 'mcmc'"""
    photographs: Literal["auto", "on", "off"] = "auto"
    """whether each photograph's exposure and white balance are learnt. auto: where EXIF or the photographs themselves
    say that they vary; a line in the log says why"""
    photograph_parts: tuple[Part, ...] = ("exposure", "white-balance")
    """what is learnt: exposure and white-balance of each photograph, vignetting and response of each camera"""
    robust_loss: float = 0.0
    """share of the pixels that the loss leaves out at most, those with the largest residuals: passers-by, moving
    shadows. 0: none; 0.1 is a start"""
    # The head decides these two; they stay because nerfstudio's exporter and viewer read them from here.
    sh_degree: tyro.conf.Suppress[int] = 3
    sh_degree_interval: tyro.conf.Suppress[int] = 1000

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Be what a config.yml says; that of an older version has fewer options, or values that are no more."""
        state = {**vars(type(self)()), **state}
        state["head_from"] = state["head_from"] or 0.0  # None: by the number of views
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
        for name in ("view_noise", "shrinkage"):
            if not getattr(self, name) >= 0:
                raise InputError(f"pipeline.model.{name} is {getattr(self, name)}; it must be zero or positive.")
        for name in ("head_from", "robust_loss"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"pipeline.model.{name} is {getattr(self, name)}; it must be at least 0 and below 1.")

    def trust(self, views: int) -> float:
        """How far so many training views trust the head, in (0, 1]."""
        return views / (views + PRIOR_VIEWS) if self.few_views == "auto" and views > 0 else 1.0
