# SPDX-License-Identifier: Apache-2.0
"""The choice of a strategy, on the command line one word: a name, then options of its own.

--pipeline.model.densification original
--pipeline.model.densification mcmc,budget=150000,refine_every=50
"""

from dataclasses import fields
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from tyro.constructors import PrimitiveConstructorSpec

from nrfgs_ns.densification.error_guided import ErrorGuided
from nrfgs_ns.densification.gradient import Original, Splatfacto
from nrfgs_ns.densification.mcmc import Mcmc
from nrfgs_ns.densification.strategy import DensificationConfig
from nrfgs_ns.errors import InputError

STRATEGIES: dict[str, type[DensificationConfig]] = {
    config.name: config for config in (Splatfacto, Original, Mcmc, ErrorGuided)
}


def strategy_from(text: str) -> DensificationConfig:
    """The options that a word on the command line stands for; `str` of them is that word.

    Raises:
        InputError: there is no such strategy or option, or a value is of the wrong kind or out of range.
    """
    name, *settings = text.split(",")
    if name not in STRATEGIES:
        raise InputError(f"There is no strategy {name!r}; use one of {', '.join(STRATEGIES)}.")
    kinds = get_type_hints(STRATEGIES[name])
    names = [field.name for field in fields(STRATEGIES[name])]
    options = {}
    for setting in settings:
        option, _, value = setting.partition("=")
        option = option.strip().replace("-", "_")
        if option not in names:
            raise InputError(f"{name} has no option {option!r}; it has {', '.join(names)}.")
        options[option] = _value(f"{name}: {option}", kinds[option], value.strip())
    config = STRATEGIES[name](**options)
    config.check()
    return config


def _value(option: str, kind: Any, text: str) -> Any:
    """A value of this type."""
    if kind is bool or get_origin(kind) is Literal:
        choices = {str(value).lower(): value for value in ((True, False) if kind is bool else get_args(kind))}
        if text.lower() in choices:
            return choices[text.lower()]
        raise InputError(f"{option} is {text!r}; use one of {', '.join(choices)}.")
    try:
        return kind(text)
    except ValueError:
        raise InputError(f"{option} is {text!r}; it must be {'a whole' if kind is int else 'a'} number.") from None


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
