# SPDX-License-Identifier: Apache-2.0
"""The page of all options, from the configurations: those that this project adds, explains or presets in its own way.

python -m nrfgs_lab.pages.options            # writes docs/options.md
"""

import dataclasses
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import docstring_parser
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.plugins.types import MethodSpecification

from nrfgs_ns import method_config
from nrfgs_ns.densification import STRATEGIES, DensificationConfig

PAGE = Path(__file__).resolve().parents[2] / "docs" / "options.md"
PACKAGES = "nrfgs_ns", "nrfgs_prepare", "nrfgs_lab"
MODEL = "pipeline.model."
APPEARANCE = "pipeline.model.appearance."

INTRODUCTION = """# Options

**This page explains the options that this package adds, with `nrfgs`'s defaults. `ns-train METHOD --help` lists all,
also learning rates.** `nrfgs-harmonics` turns off `few-views`. `nrfgs-sh`, `nrfgs-vdgs`, `nrfgs-gsnb` and `nrfgs-sg`
turn off `view-noise`, `few-views`, `shrinkage`, `dense-start`, `near-plane` and `twin`. They have splatfacto's
densification and 30,000 steps without averaging. Cameras lie within [-1, 1] scene units.
"""
SPLATFACTOS = {field.name for field in dataclasses.fields(SplatfactoModelConfig)}
"""Options of splatfacto's model, not explained here."""
LEFT_OUT = (
    *("logging.local-writer.enable", "pipeline.datamanager.cache-images-type"),
    *(APPEARANCE + name for name in ("distance-eps", "implementation", "precision", "output-init", "opacity-bound")),
    *("viewer.websocket-host", "pipeline.datamanager.image-memory", "pipeline.compact", MODEL + "warmup-steps"),
)
"""Options that few need, or that another page explains: `--help` has them."""


class Option(NamedTuple):
    """An item of the page."""

    flag: str  # with dots and hyphens, without leading hyphens
    default: Any
    text: str  # explanation


def own_options(config: Any, prefix: str = "") -> Iterator[Option]:
    """Options of a configuration, and of those inside it, that this project's code explains, named after `prefix`."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, DensificationConfig):
            value = str(value)
        elif prefix == MODEL and field.name in SPLATFACTOS:
            continue
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from own_options(value, f"{prefix}{field.name}.")
        elif not field.name.startswith("_") and "Suppress" not in str(field.type):
            text = explanation(type(config), field.name)
            if text is not None:
                yield Option((prefix + field.name).replace("_", "-"), value, text)


def explanation(config: type, name: str) -> str | None:
    """Docstring of a field in the nearest of this project's classes, or None."""
    for base in config.__mro__:
        if base.__module__.split(".")[0] in PACKAGES and name in vars(base).get("__annotations__", {}):
            return _explanations(base).get(name, "")
    return None


@cache
def _explanations(config: type) -> dict[str, str]:
    """Field -> its docstring, on one line."""
    found = docstring_parser.parse_from_object(config).params
    return {field.arg_name: " ".join((field.description or "").split()) for field in found}


def listed(options: list[Option], prefix: str = "") -> str:
    """A Markdown list: flags without their common prefix, with their defaults, and what they are."""
    lines = [f"Below `--{prefix}`:\n"] if prefix else []
    for option in options:
        lines.append(f"- **`{option.flag.removeprefix(prefix)} {option.default}`** {linked(option.text)}")
    return "\n".join(lines) + "\n"


def linked(text: str) -> str:
    """Text with links to pages of this folder."""
    return re.sub(r"docs/([\w-]+\.md)", r"[\1](\1)", text)


def methods() -> list[MethodSpecification]:
    return [value for value in vars(method_config).values() if isinstance(value, MethodSpecification)]


def page() -> str:
    options = [option for option in own_options(methods()[0].config) if option.flag not in LEFT_OUT]
    heads = [option for option in options if option.flag.startswith(APPEARANCE)]
    model = [option for option in options if option.flag.startswith(MODEL) and option not in heads]
    rest = [option for option in options if not option.flag.startswith(MODEL) and ".dataparser." not in option.flag]
    parts = [
        INTRODUCTION,
        "## The field\n",
        listed(heads, APPEARANCE),
        "## The model, with every head\n",
        listed(model, MODEL),
        strategies(),
        "## Training\n",
        listed([option._replace(flag=f"--{option.flag}") for option in rest]),
    ]
    return "\n".join(parts)


def strategies() -> str:
    """Options of the densification strategies; one item for all that explain an option alike."""
    rows: dict[tuple[str, str], dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for name, config in STRATEGIES.items():
        for option in own_options(config()):
            rows[option.flag.replace("-", "_"), option.text][str(option.default)].append(f"`{name}`")
    lines = []
    for (flag, text), defaults in rows.items():
        cells = [
            f"{', '.join(names)}: {default}" for default, names in defaults.items() if len(names) < len(STRATEGIES)
        ]
        cell = "; ".join(cells) or f"all: {next(iter(defaults))}"
        lines.append(f"- `{flag}` ({cell}): {linked(text)}")
    return (
        "### Strategies\n\nOptions of a [strategy](bench.md#densification-strategies) follow its name: "
        "`--pipeline.model.densification mcmc,budget=150000,refine_every=50`.\n\n" + "\n".join(lines) + "\n"
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
