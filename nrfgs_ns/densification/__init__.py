# SPDX-License-Identifier: Apache-2.0
"""How splats come and go during training: strategies, each a dataclass of its own options, behind one small interface.

The splats are a table, name -> parameter [N, ...]. Whatever a strategy does to the rows, it does to every tensor of the
table, whichever head it belongs to, and to the optimisers' moments. The model never asks which strategy it has.

On the command line a strategy is one word, its name and options of its own: `mcmc,budget=150000,refine_every=50`.
`strategy.py` is the interface; `gradient.py`, `error_guided.py` and `mcmc.py` have the strategies, `statistics.py` what
they share.
"""

from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec

from nrfgs_ns.densification.error_guided import ErrorGuided
from nrfgs_ns.densification.gradient import Original, Splatfacto
from nrfgs_ns.densification.mcmc import Mcmc
from nrfgs_ns.densification.strategy import CHANGE, UNSEEN, Densification, DensificationConfig
from nrfgs_ns.errors import InputError

__all__ = ["CHANGE", "STRATEGIES", "UNSEEN", "Densification", "DensificationChoice", "DensificationConfig"]
__all__ += ["ErrorGuided", "Mcmc", "Original", "Splatfacto", "strategy_from"]

STRATEGIES = {config.name: config for config in (Splatfacto, Original, Mcmc, ErrorGuided)}


def strategy_from(text: str) -> DensificationConfig:
    """The options that a word on the command line stands for; `str` of them is that word.

    Raises:
        InputError: there is no such strategy or option, or a value is of the wrong kind or out of range.
    """
    name, *settings = text.split(",")
    if name not in STRATEGIES:
        raise InputError(f"There is no strategy {name!r}; use one of {', '.join(STRATEGIES)}.")
    config = STRATEGIES[name]()
    for setting in settings:
        option, _, value = (part.strip() for part in setting.partition("="))
        option = option.replace("-", "_")
        if option not in vars(config):
            raise InputError(f"{name} has no option {option!r}; it has {', '.join(vars(config))}.")
        kind = type(getattr(config, option))
        try:
            setattr(config, option, kind(value))
        except ValueError:
            number = "a whole number" if kind is int else "a number"
            raise InputError(f"{name}: {option} is {value!r}; it must be {number}.") from None
    config.check()
    return config


DensificationChoice = Annotated[
    DensificationConfig,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(STRATEGIES)}}}[,OPTION=VALUE...]",
        instance_from_str=lambda words: strategy_from(words[0]),
        is_instance=lambda value: isinstance(value, DensificationConfig),
        str_from_instance=lambda value: [str(value)],
    ),
]
"""A strategy as an option of a configuration."""
