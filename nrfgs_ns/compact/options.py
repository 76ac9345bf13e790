# SPDX-License-Identifier: Apache-2.0
"""Options of `nrfgs export compact`. Imports next to nothing: `nrfgs --help` reads it."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from nrfgs_ns.compact.precision import Precision


@dataclass
class CompactOptions:
    """What a compact file may leave out."""

    finetune: Annotated[int, tyro.conf.arg(aliases=("--finetune",))] = 0
    """steps in which the model is trained on for the file: tables that cost less, and how finely each is rounded"""
    rate: float = 1e-4
    """with finetune: how much of the training's loss a byte for each splat is worth. More: a smaller file"""
    rank: int | None = None
    """numbers in a latent. None: as few as the budget allows"""
    threshold: float | None = None
    """splats whose residual changes no training view by this many 8-bit steps become diffuse; 0 for none. None: as many
    as the budget allows"""
    budget: float = 0.03
    """dB that rank and threshold, where they are not given, may cost on some training views"""
    views: int = 8
    """training views, evenly spaced, on which they are chosen"""
    precision: Precision = field(default_factory=Precision)
    """steps to which numbers are rounded"""
