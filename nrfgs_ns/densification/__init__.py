# SPDX-License-Identifier: Apache-2.0
"""How splats come and go during training: one class per strategy behind one small interface.

- `splatfacto`: nerfstudio's rules and thresholds, all of them options of the model.
- `original`: 3DGS (Kerbl et al. 2023): mean screen-space gradients above 2e-4 grow, opacities below 0.005 go, sizes are
  measured against the extent of the cameras.
- `mcmc`: 3DGS-MCMC (Kheradmand et al. 2024): nothing is deleted. Dead splats move to live ones, noise explores, and
  the count grows to a budget and stays there.

The splats are a table, name -> parameter [N, ...]. Whatever a strategy does to the rows, it does to every tensor of the
table, whoever's head it belongs to, and to the optimisers' moments. The model never asks which strategy it has.

`strategy.py` is the interface, `gradient.py` and `mcmc.py` (with `relocation.py`) have the strategies, `thinning.py`
has what goes once growth has ended, `build.py` the choice.
"""

from nrfgs_ns.densification.build import UNREAD, build_densification
from nrfgs_ns.densification.gradient import GradientDensification, OriginalDensification
from nrfgs_ns.densification.mcmc import Mcmc, McmcDensification
from nrfgs_ns.densification.strategy import (
    CHANGE,
    UNSEEN,
    Densification,
    OpacitySeen,
    Strategy,
    TrainingViews,
)

__all__ = [
    "CHANGE",
    "UNREAD",
    "UNSEEN",
    "Densification",
    "GradientDensification",
    "Mcmc",
    "McmcDensification",
    "OpacitySeen",
    "OriginalDensification",
    "Strategy",
    "TrainingViews",
    "build_densification",
]
