# SPDX-License-Identifier: Apache-2.0
"""From knobs to a benchmark: the default, and each knob turned away from it alone.

    default: {method: nrfgs}                    # a method of ns-train, or a method with options
    knobs:
      D: {option: --pipeline.model.appearance.latent-dim, values: [4, 8, 16]}
      steps: {steps: [7000, 15000]}
      splat budget: {strategies: [mcmc@200000, mcmc@1000000]}
      precision: {option: --pipeline.model.appearance.precision, values: [fp32, fp16], cuda: true}
      head:
        settings:                               # whatever else: name -> method, options, strategy, steps
          SH 0: {method: nrfgs-sh, options: --pipeline.model.appearance.degree 0}
          one branch: {options: --pipeline.model.appearance.split-bands False}

Every other key is one of `nrfgs bench`: scenes, seeds, steps, options, ... A setting has the default's method and
options, and its own behind them; one that names a method has its own options only.
"""

from dataclasses import dataclass
from typing import Any

from nrfgs_lab.bench.spec import as_list, words_of
from nrfgs_ns.errors import InputError

DEFAULT = "default"
"""Name of the run that all others are compared with."""
KINDS = ("option", "steps", "strategies", "settings")
SETTING_KEYS = ("method", "options", "strategy", "steps")


@dataclass(frozen=True)
class Setting:
    """One knob at one value."""

    knob: str
    value: str

    @property
    def name(self) -> str:
        """Name of its run."""
        return self.knob if self.knob == DEFAULT else f"{self.knob} {self.value}"


def bench_plan(
    content: dict[str, Any], where: str, cuda: bool, only: tuple[str, ...] = ()
) -> tuple[dict[str, Any], list[Setting]]:
    """The benchmark of a file of knobs.

    Args:
        content: keys and values as in the module's docstring.
        where: what error messages call it.
        cuda: keep the knobs that only a GPU has.
        only: names of the knobs to turn, or of single settings, as in "steps 7000"; none for all.

    Returns:
        What `nrfgs bench` takes as a file, and the settings, the default first, in the order of its runs.

    Raises:
        InputError: naming the key and the fix.
    """
    rest = {key: value for key, value in content.items() if key not in (DEFAULT, "knobs")}
    _require("runs" not in rest, f"{where}: runs are made from {DEFAULT} and knobs. Leave runs out.")
    _require(
        len(as_list(rest.get("strategies", []))) <= 1,
        f"{where}: strategies names several; a trade compares with one. Make the others values of a knob.",
    )
    default = content.get(DEFAULT, "nrfgs")
    default = {"method": default} if isinstance(default, str) else default
    _require(
        isinstance(default, dict) and "method" in default,
        f"{where}: {DEFAULT} names no method. Write {DEFAULT}: nrfgs, or {DEFAULT}: {{method: nrfgs, options: ...}}.",
    )
    knobs = content.get("knobs")
    _require(isinstance(knobs, dict) and bool(knobs), f"{where}: knobs is missing or empty. Name at least one.")
    runs, settings, names = {DEFAULT: dict(default)}, [Setting(DEFAULT, "")], {DEFAULT}
    for knob, description in knobs.items():
        values = _values(knob, description, f"{where}: knobs: {knob}")
        for value, changes in values.items():
            setting = Setting(str(knob), value)
            _require(setting.name not in names, f"{where}: {setting.name!r} is there twice. Give knobs distinct names.")
            names.add(setting.name)
            is_chosen = not only or str(knob) in only or setting.name in only
            if is_chosen and (cuda or not description.get("cuda", False)):
                runs[setting.name] = _run(default, changes, f"{where}: {setting.name}")
                settings.append(setting)
    unknown = sorted(set(only) - names - set(map(str, knobs)))
    _require(
        not unknown,
        f"{where} has no knob {', '.join(unknown)}. It has {', '.join(map(str, knobs))}; "
        "a single setting is named by its knob and its value, as in 'steps 7000'.",
    )
    return {**rest, "runs": runs}, settings


def _values(knob: str, description: Any, where: str) -> dict[str, dict[str, Any]]:
    """Value -> what it changes."""
    kinds = [kind for kind in KINDS if isinstance(description, dict) and kind in description]
    _require(len(kinds) == 1, f"{where} needs exactly one of {', '.join(KINDS)}.")
    known = {kinds[0], "cuda", *(["values"] if kinds[0] == "option" else [])}
    unknown = sorted(set(description) - known)
    _require(not unknown, f"{where}: unknown key {', '.join(unknown)}. Known here are {', '.join(sorted(known))}.")
    if kinds[0] == "settings":
        changes = description["settings"]
        _require(isinstance(changes, dict) and bool(changes), f"{where}: settings must map names to options.")
        for name, change in changes.items():
            good = isinstance(change, dict) and set(change) <= set(SETTING_KEYS)
            _require(good, f"{where}: {name} may have {', '.join(SETTING_KEYS)}, and is {change!r}.")
        return {str(name): change for name, change in changes.items()}
    if kinds[0] == "option":
        option, values = description["option"], description.get("values")
        _require(
            isinstance(option, str) and isinstance(values, list) and bool(values),
            f"{where} needs option: --some.option and values: [...].",
        )
        return {str(value): {"options": [option, str(value)]} for value in values}
    values = description[kinds[0]]
    _require(isinstance(values, list) and bool(values), f"{where}: {kinds[0]} must be a list.")
    one = {"steps": "steps", "strategies": "strategy"}[kinds[0]]
    return {str(value): {one: value} for value in values}


def _run(default: dict[str, Any], changes: dict[str, Any], where: str) -> dict[str, Any]:
    """A run of `nrfgs bench`: the default with changes."""
    run = {"method": changes["method"]} if "method" in changes else dict(default)
    options = [word for one in (run, changes) for word in words_of(one.get("options", ()), f"{where}: options")]
    if options:
        run["options"] = options
    if "strategy" in changes:
        run["strategies"] = [str(changes["strategy"])]
    if "steps" in changes:
        run["steps"] = changes["steps"]
    return run


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise InputError(message)
