# SPDX-License-Identifier: Apache-2.0
"""How splats come and go during training: strategies, each a dataclass of its own options, behind one small interface.

- `splatfacto`: nerfstudio's rules and thresholds.
- `original`: 3DGS (Kerbl et al. 2023): mean screen-space gradients above 2e-4 grow, opacities below 0.005 go, sizes are
  measured against the extent of the cameras.
- `error-guided`: brush's and LichtFeld's growth by error; opacities decay and are not reset.
- `mcmc`: 3DGS-MCMC (Kheradmand et al. 2024): nothing is deleted. Dead splats move to live ones, noise explores, and
  the count grows to a budget and stays there.

The splats are a table, name -> parameter [N, ...]. Whatever a strategy does to the rows, it does to every tensor of the
table, whichever head it belongs to, and to the optimisers' moments. The model never asks which strategy it has.

`strategy.py` is the interface, `choice.py` the option on the command line; `gradient.py`, `error_guided.py` and
`mcmc.py` (with `relocation.py`) have the strategies.
"""

from nrfgs_ns.densification.choice import STRATEGIES, DensificationChoice, strategy_from
from nrfgs_ns.densification.error_guided import ErrorGuided
from nrfgs_ns.densification.gradient import Original, Splatfacto
from nrfgs_ns.densification.mcmc import Mcmc
from nrfgs_ns.densification.strategy import (
    CHANGE,
    UNSEEN,
    Densification,
    DensificationConfig,
    OpacitySeen,
)

__all__ = [
    "CHANGE",
    "STRATEGIES",
    "UNSEEN",
    "Densification",
    "DensificationChoice",
    "DensificationConfig",
    "ErrorGuided",
    "Mcmc",
    "OpacitySeen",
    "Original",
    "Splatfacto",
    "strategy_from",
]
