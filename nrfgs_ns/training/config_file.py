# SPDX-License-Identifier: Apache-2.0
"""config.yml read as a configuration and as nothing else.

Nerfstudio saves a training's configuration as YAML with Python tags, and its own commands construct whatever those
name: `!!python/object/apply:os.system` in a shared file is run. Here a file may name

    configuration classes of nerfstudio (subclasses of its PrintableConfig), dataclasses of this project and of packages
    that register methods with nerfstudio
    what a configuration sets up (`_target`): its default's class or a subclass of it, or an optimiser of torch
    paths, tuples, and enums of these packages

and anything else is refused with its line. Values are checked against the types of the dataclasses' fields; an option
that is newer than the file has its default. Written for what nerfstudio 1.1.5 saves by PyYAML 6.
"""

import importlib
import os
import re
import types
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import torch
import yaml
from nerfstudio.configs.base_config import PrintableConfig
from nerfstudio.configs.experiment_config import ExperimentConfig
from nerfstudio.engine.trainer import TrainerConfig

from nrfgs_ns.compact.format import MAGIC
from nrfgs_ns.errors import InputError


@cache
def _plugins() -> set[str]:
    """Names of this project's packages, and of others that register methods."""
    named = os.environ.get("NERFSTUDIO_METHOD_CONFIGS", "").split(",")
    values = [one.value for one in entry_points(group="nerfstudio.method_configs")]
    values += [one.partition("=")[2] for one in named]
    return {"nrfgs_ns", "nrfgs_lab", *(re.split("[.:]", value)[0] for value in values)} - {""}


def _is_known(name: str) -> bool:
    """Whether a file may name this class, or one of this module."""
    package = name.partition(".")[0]
    return package in _plugins() or package == "nerfstudio" or name.startswith("torch.optim.")


def read_config(path: Path) -> TrainerConfig:
    """The configuration of a training; InputError where the file is no whole one, names anything else than the module's
    docstring lists, or has a value of another type than its option."""
    fix = "Name the config.yml that the training saved"
    if not path.is_file():
        raise InputError(f"{path}: no such file. {fix}.")
    if (data := path.read_bytes()).startswith(MAGIC):
        raise InputError(f"{path} is a compact file. Name the config.yml in {path}.nerfstudio instead.")
    try:
        config = yaml.load(data.decode(), Loader=_Loader)
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"{path} is not a configuration: {' '.join(str(error).split())}. {fix}.") from error
    if not isinstance(config, TrainerConfig):
        raise InputError(f"{path} is not the configuration of a training. {fix}.")
    check_types(config, str(path))
    return config


def check_types(config: Any, source: str, prefix: str = "") -> None:
    """Raise InputError, naming `source`, where an option's value has another type than its dataclass's field, anywhere
    in a configuration or a dictionary of such. A value that is its field's default passes."""
    if isinstance(config, dict):
        for key, value in config.items():
            check_types(value, source, f"{prefix}{key}.")
    if not is_dataclass(config) or isinstance(config, type):
        return
    hints = get_type_hints(type(config))
    for field in fields(config):
        value, hint = getattr(config, field.name), hints[field.name]
        name = f"{prefix}{field.name}"
        if field.name.startswith("_") or (not is_dataclass(value) and value == _default(field)):
            continue
        if not _is_a(value, hint):
            kind = hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")
            raise InputError(f"{source}: {name} is {value!r}, which is not of its type, {kind}. Correct it.")
        check_types(value, source, f"{name}.")


def _is_a(value: Any, hint: Any) -> bool:
    """Whether a value has the type that a field's annotation names; items of containers are not checked."""
    kind = get_origin(hint) or hint
    if kind in (Union, types.UnionType):
        return any(_is_a(value, option) for option in get_args(hint))
    if kind is Literal:
        return value in get_args(hint) or value == ""  # `vis` without any log
    if kind is tuple and isinstance(value, list):  # tyro's own defaults have either
        return True
    if kind in (int, float):
        return isinstance(value, (int, kind)) and not isinstance(value, bool)
    return not isinstance(kind, type) or isinstance(value, kind)


def _default(field: Field) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


class _Loader(yaml.SafeLoader):
    """YAML's plain types, and the tags that the module's docstring lists."""


def _refuse(node: yaml.Node, name: str, failure: Exception | None = None) -> yaml.YAMLError:
    why = "which is no option of nerfstudio, nrfgs_ns or an installed package that registers methods (nerfstudio's own "
    why += "commands read a file that you trust)"
    if failure is not None:
        why = f"whose package is missing or broken ({type(failure).__name__}: {failure})"
    return yaml.constructor.ConstructorError(problem=f"it asks for {name!r}, {why}", problem_mark=node.start_mark)


def _class(loader: _Loader, name: str, node: yaml.Node) -> type:
    """`!!python/name:`, a class of one of the packages. `_object` decides what it may be used for."""
    module, _, attribute = name.rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), attribute) if _is_known(name) else None
    except Exception as failure:  # whatever importing it leads to
        raise _refuse(node, name, failure) from failure
    if not isinstance(kind, type) or not _is_known(kind.__module__):
        raise _refuse(node, name)
    return kind


def _object(loader: _Loader, name: str, node: yaml.Node):
    """`!!python/object:`, a configuration; options that the file lacks have their defaults."""
    kind = _class(loader, name, node)
    if not is_dataclass(kind) or not (
        issubclass(kind, PrintableConfig) or kind.__module__.partition(".")[0] in _plugins()
    ):
        raise _refuse(node, name)
    config = kind.__new__(kind)
    yield config
    values = loader.construct_mapping(node, deep=True)
    defaults = {field.name: _default(field) for field in fields(kind)}
    for key, value in values.items():
        if isinstance(value, type) and not (
            key == "_target" and (issubclass(value, torch.optim.Optimizer) or issubclass(value, defaults[key]))
        ):
            raise _refuse(node, f"{value.__module__}.{value.__qualname__}")
    needed = {key for key, value in defaults.items() if value is MISSING}
    if issubclass(kind, ExperimentConfig):  # a file that is cut off lacks some
        needed |= {field.name for field in fields(ExperimentConfig)}
    if missing := sorted(needed - values.keys()):
        raise yaml.YAMLError(f"it lacks {', '.join(missing[:3])}")
    vars(config).update(defaults | values)


def _apply(loader: _Loader, name: str, node: yaml.Node) -> Any:
    """`!!python/object/apply:`, a path or an enum's value."""
    arguments = loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else [None]
    if name.startswith("pathlib.") and all(isinstance(part, str) for part in arguments):
        return Path(*arguments)
    if name == "builtins.getattr":  # how Python 3.11.0 to 3.11.3 write an enum: its class and the member's name
        kind, member = arguments
        if isinstance(kind, type) and issubclass(kind, Enum) and member in kind.__members__:
            return kind[member]
        raise _refuse(node, name)
    kind = _class(loader, name, node)
    if not issubclass(kind, Enum) or len(arguments) != 1:
        raise _refuse(node, name)
    return kind(arguments[0])


TAG = "tag:yaml.org,2002:python/"
_Loader.add_multi_constructor(f"{TAG}name:", _class)
_Loader.add_multi_constructor(f"{TAG}object:", _object)
_Loader.add_multi_constructor(f"{TAG}object/apply:", _apply)
_Loader.add_constructor(f"{TAG}tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True)))
