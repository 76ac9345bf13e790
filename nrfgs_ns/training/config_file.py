# SPDX-License-Identifier: Apache-2.0
"""config.yml read as a configuration and as nothing else.

Nerfstudio saves a training's configuration as YAML with Python tags, and its own commands construct whatever those
name: `!!python/object/apply:os.system` in a file that somebody hands on is run. Here a file may name

    configuration classes of nerfstudio (subclasses of its PrintableConfig) and dataclasses of this package
    what a configuration sets up (`_target`): its default's class or a subclass of it, or an optimiser of torch
    paths, tuples, and enums of either package

and everything else stops with a sentence that has the line. Read in: nerfstudio 1.1.5, PyYAML 6.
"""

import importlib
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.configs.base_config import PrintableConfig
from nerfstudio.engine.trainer import TrainerConfig

from nrfgs_ns.errors import InputError

LARGEST_FILE = 1 << 20
"""Bytes; a config.yml has ten thousand."""
NERFSTUDIO, OURS, OPTIMISERS = "nerfstudio", "nrfgs_ns", "torch.optim"
PATHS = {
    f"{module}.{name}" for module in ("pathlib", "pathlib._local") for name in ("Path", "PosixPath", "WindowsPath")
}


def read_config(path: Path) -> TrainerConfig:
    """The configuration of a training.

    Raises:
        InputError: there is no such file, it is no configuration, or it names what is none.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file. Name the config.yml that the training saved.")
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(f"{path} is larger than {LARGEST_FILE} bytes. Name the config.yml that the training saved.")
    try:
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a configuration. Name the config.yml that the training saved.") from error
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"{path} is not a configuration: {' '.join(str(error).split())}.") from error
    if not isinstance(config, TrainerConfig):
        raise InputError(f"{path} is not the configuration of a training. Name the config.yml that the training saved.")
    return config


class _Loader(yaml.SafeLoader):
    """YAML's plain types, and the tags that the module's docstring lists."""


def _refuse(node: yaml.Node, name: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(
        problem=f"it asks for {name!r}, which is no option of nerfstudio or {OURS}. If you trust the file, "
        "nerfstudio's own commands read it",
        problem_mark=node.start_mark,
    )


def _part_of(name: str, package: str) -> bool:
    return name.startswith(f"{package}.")


def _class(node: yaml.Node, name: str) -> type:
    """The class of this full name, if it is one of the packages' own."""
    if not any(_part_of(name, package) for package in (NERFSTUDIO, OURS, OPTIMISERS)):
        raise _refuse(node, name)
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise _refuse(node, name) from error
    if not isinstance(found, type) or not any(
        _part_of(found.__module__, package) for package in (NERFSTUDIO, OURS, OPTIMISERS)
    ):
        raise _refuse(node, name)
    return found


def _name(loader: _Loader, suffix: str, node: yaml.Node) -> type:
    """`!!python/name:`, which may be a `_target`: `_object` looks whose."""
    return _class(node, suffix)


def _object(loader: _Loader, suffix: str, node: yaml.Node):
    """`!!python/object:`, a configuration."""
    kind = _class(node, suffix)
    config = is_dataclass(kind) and (issubclass(kind, PrintableConfig) or _part_of(kind.__module__, OURS))
    if not config and not (_part_of(kind.__module__, OURS) and kind.__module__.endswith(".retired")):
        raise _refuse(node, suffix)
    made = kind.__new__(kind)
    yield made
    values = loader.construct_mapping(node, deep=True)
    for name, value in values.items():
        if isinstance(value, type) and not (name == "_target" and _fits(kind, value)):
            raise _refuse(node, f"{value.__module__}.{value.__qualname__}")
        if callable(getattr(kind, str(name), None)) and name != "_target":
            raise _refuse(node, f"{suffix}.{name}")
    getattr(made, "__setstate__", made.__dict__.update)(values)


def _fits(config: type, target: type) -> bool:
    """Whether a configuration of this class may set up objects of that one."""
    if issubclass(target, torch.optim.Optimizer):
        return True
    for field in fields(config):
        if field.name == "_target":
            default = field.default_factory() if field.default is MISSING else field.default
            return isinstance(default, type) and issubclass(target, default)
    return False


def _apply(loader: _Loader, suffix: str, node: yaml.Node) -> Any:
    """`!!python/object/apply:`, a path or an enum's value."""
    arguments = loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else [None]
    if suffix in PATHS and all(isinstance(part, str) for part in arguments):
        return Path(*arguments)
    if suffix == "builtins.getattr":  # how Python 3.11.0 to 3.11.3 write an enum: its class and the member's name
        kind, name = arguments if len(arguments) == 2 else (None, None)
        if isinstance(kind, type) and issubclass(kind, Enum) and isinstance(name, str) and name in kind.__members__:
            return kind[name]
        raise _refuse(node, suffix)
    kind = _class(node, suffix)
    if not issubclass(kind, Enum) or len(arguments) != 1:
        raise _refuse(node, suffix)
    return kind(arguments[0])


TAG = "tag:yaml.org,2002:python/"
_Loader.add_multi_constructor(f"{TAG}name:", _name)
_Loader.add_multi_constructor(f"{TAG}object:", _object)
_Loader.add_multi_constructor(f"{TAG}object/apply:", _apply)
_Loader.add_constructor(f"{TAG}tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True)))
