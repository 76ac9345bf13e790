# SPDX-License-Identifier: Apache-2.0
"""The page of all options: read from the configurations, so that it cannot say anything else than they do.

    python -m nrfgs_lab.pages.options            # writes docs/options.md

Of what `ns-train` offers it has the options that this project adds, or that it explains or presets in its own way;
nerfstudio's own are in `ns-train METHOD --help`, with these.
"""

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from nerfstudio.plugins.types import MethodSpecification

from nrfgs_ns import method_config
from nrfgs_ns.cli import commands
from nrfgs_ns.data.dataparser import NrfgsDataParserConfig

PAGE = Path(__file__).resolve().parents[2] / "docs" / "options.md"
PACKAGES = "nrfgs_ns", "nrfgs_lab"
MODEL = "pipeline.model."
APPEARANCE = "pipeline.model.appearance."

INTRODUCTION = """# Options

What this package adds to nerfstudio's options, or presets in its own way; all are in `ns-train nrfgs --help`.
Written by `python -m nrfgs_lab.pages.options` from the configurations. Cameras lie within [-1, 1] scene units. Defaults
are `nrfgs`'s; of the other heads' methods `view-noise` and `shrinkage` are 0, `few-views` is off,
`max-num-iterations` 30,000 and `average-steps` 0.
"""
RULES = "original", "mcmc"
"""Densification strategies with options of their own."""
UNSAID = "none", "required", "False"
"""Defaults that a list of options does not tell."""
HOST = "`--vis`, `--load-dir`, `--output-dir` and `--machine.seed` are nerfstudio's.\n"


class Option(NamedTuple):
    """A line of the page."""

    flag: str
    """with dots and hyphens, without leading hyphens"""
    default: Any
    text: str
    """what it does"""


def own_options(config: Any, prefix: str = "") -> Iterator[Option]:
    """The options of a configuration, and of those inside it, whose explanation stands in this project's code.

    Args:
        config: a dataclass's instance, which has the defaults.
        prefix: dotted names down to it.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from own_options(value, f"{prefix}{field.name}.")
        elif not field.name.startswith("_") and "Suppress" not in str(field.type):
            text = explanation(type(config), field.name)
            if text is not None:
                yield Option((prefix + field.name).replace("_", "-"), value, text)


def explanation(config: type, name: str) -> str | None:
    """What the nearest of this project's classes says of a field, or None if none of them has it."""
    for base in config.__mro__:
        if base.__module__.split(".")[0] in PACKAGES and name in vars(base).get("__annotations__", {}):
            return _explanations(base)[name]
    return None


@cache
def _explanations(config: type) -> dict[str, str]:
    """Field -> the string that follows it in the source, on one line."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(config))).body
    found = {}
    for node, following in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign):
            is_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            found[node.target.id] = " ".join(following.value.value.split()) if is_text else ""
    return found


def table(options: list[Option], prefix: str = "") -> str:
    """A Markdown table, the flags without the prefix that they share."""
    lines = [f"| `--{prefix}` | default | |" if prefix else "| | default | |", "|---|---|---|"]
    for option in options:
        text = linked(option.text.replace("|", "\\|"))
        lines.append(f"| `{option.flag.removeprefix(prefix)}` | {_shown(option.default)} | {text} |")
    return "\n".join(lines) + "\n"


def linked(text: str) -> str:
    """A text whose pages of this folder are links."""
    return re.sub(r"docs/([\w-]+\.md)", r"[\1](\1)", text)


def _shown(default: Any) -> str:
    if default is dataclasses.MISSING:
        return "required"
    if default is None or default == "" or default == ():
        return "none"
    if isinstance(default, (tuple, list)):
        return " ".join(map(str, default))
    return default.as_posix() if isinstance(default, Path) else str(default)


def methods() -> list[MethodSpecification]:
    """The registered methods."""
    return [value for value in vars(method_config).values() if isinstance(value, MethodSpecification)]


def page() -> str:
    """The whole page."""
    first, *others = methods()
    options = list(own_options(first.config))
    heads = [option for option in options if option.flag.startswith(APPEARANCE)]
    model = [option for option in options if option.flag.startswith(MODEL) and option not in heads]
    rules = {name: [one for one in model if one.flag.startswith(f"{MODEL}{name}.")] for name in RULES}
    model = [option for option in model if option not in sum(rules.values(), [])]
    rest = [option._replace(flag=f"--{option.flag}") for option in options if not option.flag.startswith(MODEL)]
    data = [option._replace(flag=f"--{option.flag}") for option in own_options(NrfgsDataParserConfig())]
    parts = [
        INTRODUCTION,
        "## `ns-train nrfgs`: the field\n",
        table(heads, APPEARANCE),
        "## All methods: the model\n",
        table(model, MODEL),
        _of_rules(rules),
        "## All methods: training\n",
        table([option for option in rest if ".dataparser." not in option.flag]),
        HOST,
        "## All methods: the data set\n\nAfter the word `nrfgs-data`, at the end of the command.\n",
        table(data),
    ]
    presets = [method for method in others if is_preset(method, first)]
    parts += ["## Presets\n", *(f"`ns-train {one.config.method_name}`: {linked(one.description)}\n" for one in presets)]
    parts += ["## The other heads\n\nTheir `--pipeline.model.appearance.` options; `--help` explains each.\n"]
    rows = [
        (one.config.method_name, own_options(one.config.pipeline.model.appearance), one.description)
        for one in others
        if one not in presets
    ]
    parts += [_listed(rows), "## Learning rates\n", rates(first)]
    parts += ["## Commands\n\n`nrfgs COMMAND --help` lists and explains their options.\n"]
    lines = ["| command | |", "|---|---|"]
    for name, entry_point in commands().items():
        summary, *_ = inspect.getdoc(entry_point.load()).splitlines()
        lines.append(f"| `nrfgs {name}` | {linked(summary)} |")
    return "\n".join([*parts, *lines]) + "\n"


def _of_rules(rules: dict[str, list[Option]]) -> str:
    """The options of densification strategies, in a sentence; `--help` explains each."""
    parts = []
    for name, options in rules.items():
        shown = (f"`{one.flag.removeprefix(f'{MODEL}{name}.')}` {_shown(one.default)}" for one in options)
        parts.append(f"`--{MODEL}{name}.`: {', '.join(shown)}")
    return f"Thresholds of the strategies ([bench.md](bench.md#densification-strategies)): {'. '.join(parts)}.\n"


def _listed(rows: list[tuple[str, Iterator[Option], str]]) -> str:
    """A table of methods by name, with their options and defaults in one cell."""
    lines = ["| method | | options |", "|---|---|---|"]
    for name, options, text in rows:
        shown = [(option.flag, _shown(option.default)) for option in options]
        cell = ", ".join(f"`{flag}`" + ("" if value in UNSAID else f" {value}") for flag, value in shown)
        lines.append(f"| `{name}` | {linked(text)} | {cell} |")
    return "\n".join(lines) + "\n"


def is_preset(method: MethodSpecification, of: MethodSpecification) -> bool:
    """Whether a method has the same head as another one."""
    return type(method.config.pipeline.model.appearance) is type(of.config.pipeline.model.appearance)


def rates(method: MethodSpecification) -> str:
    """The learning rates of a method's parameters, in a sentence."""
    parts = []
    for name, group in method.config.optimizers.items():
        scheduler = group["scheduler"]
        final = "" if scheduler is None else f" to {scheduler.lr_final:g}"
        parts.append(f"`{name}` {group['optimizer'].lr:g}{final}")
    return f"`--optimizers.NAME.optimizer.lr` to `.scheduler.lr-final`: {', '.join(parts)}.\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
