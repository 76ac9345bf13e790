# SPDX-License-Identifier: Apache-2.0
"""How splats come and go during training: strategies, each a dataclass of its own options, behind one small interface.

The splats are a table, name -> parameter [N, ...]. Whatever a strategy does to the rows, it does to every tensor of the
table, whichever head it belongs to, and to the optimisers' moments. The model never asks which strategy it has.

`strategy.py` is the interface, `choice.py` the option on the command line; `gradient.py`, `error_guided.py` and
`mcmc.py` (with `relocation.py`) have the strategies, `statistics.py` and `rows.py` what they share.
"""

from nrfgs_ns.densification.choice import STRATEGIES, DensificationChoice, strategy_from
from nrfgs_ns.densification.error_guided import ErrorGuided
from nrfgs_ns.densification.gradient import Original, Splatfacto
from nrfgs_ns.densification.mcmc import Mcmc
from nrfgs_ns.densification.strategy import CHANGE, UNSEEN, Densification, DensificationConfig

__all__ = [
    "CHANGE",
    "STRATEGIES",
    "UNSEEN",
    "Densification",
    "DensificationChoice",
    "DensificationConfig",
    "ErrorGuided",
    "Mcmc",
    "Original",
    "Splatfacto",
    "strategy_from",
]
