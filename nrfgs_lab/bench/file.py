# SPDX-License-Identifier: Apache-2.0
"""A benchmark from a YAML file.

docs/bench.md describes the file; its keys are the fields of `Spec`, `Method` (a run) and `Scene`. A plan may have a
default and knobs instead of runs. Each knob is varied alone, and the report compares every setting with the default
(`trade.py`):

    default: nrfgs
    knobs:
      D: {option: --pipeline.model.appearance.latent-dim, values: [4, 8, 16]}
      steps: {steps: [7000, 15000]}
      budget: {strategies: [mcmc@200000, mcmc@1000000]}
      head: {settings: {SH: nrfgs-sh, one branch: {options: --pipeline.model.appearance.split-bands False}}}

A setting has the default's method and options, and its own after them; if it names a method, only its own.
"""

import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import yaml

from nrfgs_lab.bench.spec import DEFAULT, OWN, Method, Scene, Spec, cells_of, is_ours, strategies_of, strategy_options
from nrfgs_ns.errors import InputError

SET_HERE = {
    **dict.fromkeys(("--output-dir", "--experiment-name", "--load-dir"), "leave it out"),
    **dict.fromkeys(("--max-num-iterations", "--time-budget"), "use steps, of the file or of a run"),
    "--steps-per-save": "use checkpoint_every",
    "--machine.seed": "use seeds",
}
"""Options of ns-train that the benchmark sets -> what to use instead."""
PLANS = Path(__file__).parent / "plans"
"""The files that the package has."""
NO_KEYS = {Method: ("name",), Scene: ("held_out", "held_out_every", "held_out_by")}
"""Fields that a file does not give."""
LISTS = "strategies", "seeds", "held_out"
"""Keys with a list of values, or with one."""
LEASTS = {
    **dict.fromkeys(("steps", "downscale", "views", "jobs", "gpus", "checkpoint_every"), 1),
    **dict.fromkeys(("seeds", "held_out", "train_views"), 0),
    "held_out_every": 2,
}
"""Key whose values are whole numbers -> the smallest."""


class _Loader(yaml.SafeLoader):
    """YAML with unique keys: the later of two would silently replace the other."""

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(problem=f"{twice!r} twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def load_spec(path: Path, plan: str = "") -> dict[str, Any]:
    """Content of a YAML file, or of one of its `plans`, for `make_spec`; InputError if it cannot be read. The path may
    be a name in `PLANS`."""
    shipped = PLANS / f"{path}.yaml"
    path = shipped if shipped.is_file() and not path.is_file() else path
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path} cannot be read as YAML ({error}). See docs/bench.md for an example.") from error
    plans = content.get("plans", {"": content}) if isinstance(content, dict) else {}
    good = isinstance(plans, dict) and plans and all(isinstance(one, dict) for one in plans.values())
    _require(good, f"{path} must be a mapping (runs: ..., scenes: ...), or have plans. See docs/bench.md.")
    if plan not in plans:
        choice = "no plans. Leave out --plan" if "" in plans else f"{', '.join(plans)}. Give --plan one of them"
        raise InputError(f"{path} has {choice}.")
    return plans[plan]


def make_spec(content: dict[str, Any], where: str) -> Spec:
    """Check and complete a file's content; an InputError begins with `where`, and names the key and the fix."""
    if "knobs" in content:
        content = _with_runs_of_knobs(content, where)
    content = _checked(content, Spec, where)
    for key in ("runs", "scenes"):
        _require(bool(content.get(key)), f"{where}: {key} is missing or empty. Name at least one.")
    _require(isinstance(content["runs"], dict), f"{where}: runs must map names to methods.")
    lists = {key: as_list(content[key]) for key in LISTS if key in content}
    runs = [_method(name, value, f"{where}: runs: {name}") for name, value in content["runs"].items()]
    scenes = [_scene(value, f"{where}: scenes") for value in as_list(content["scenes"])]
    spec = Spec(**{**content, **lists, "runs": runs, "scenes": scenes})
    if spec.held_out:
        order = {"held_out_every": spec.held_out_every, "held_out_by": spec.held_out_by}
        _require(spec.held_out_by in ("name", "place"), f"{where}: held_out_by must be name or place.")
        versions = [{"held_out": first, **order} for first in spec.held_out]
        spec.scenes = [replace(scene, **version) for version in versions for scene in spec.scenes]
    _require_free(spec.options, SET_HERE, f"{where}: options")
    for run in spec.runs:
        _check_run(run, spec, f"{where}: runs: {run.name}")
    names = [cell.name for cell in cells_of(spec)]
    _require(bool(names), f"{where}: strategies or seeds is empty. Name at least one, or leave it out.")
    twice = sorted({name for name in names if names.count(name) > 1})
    _require(
        not twice,
        f"{where}: {', '.join(twice[:3])} would be trained twice. Give runs and scenes distinct names, and each "
        "strategy and seed once.",
    )
    return spec


def _check_run(run: Method, spec: Spec, where: str) -> None:
    _require_free(run.options, SET_HERE, f"{where}: options")
    unknown = set(run.scenes) - {name for scene in spec.scenes for name in (scene.name, scene.path)}
    _require(not unknown, f"{where}: scenes: the plan has no {', '.join(sorted(unknown))}. Name some that it has.")
    for strategy in strategies_of(run, spec):
        options = strategy_options(strategy)
        given = dict.fromkeys(options, f"strategy {strategy} gives it; use strategy own")
        _require_free((*spec.options, *run.options), given, where)
        _require(
            not options or is_ours(run.method),
            f"{where}: {run.method} knows no strategy {strategy!r}; only this project's methods do. Use own, and the "
            "method's options.",
        )


def scene_path(value: Any) -> str:
    """Folder of a scene in a file."""
    return Path(str(value.get("path", value) if isinstance(value, dict) else value)).as_posix()


def _method(name: Any, value: Any, where: str) -> Method:
    value = _description(value, Method, "method", where)
    value |= {key: tuple(map(str, as_list(value[key]))) for key in ("strategies", "scenes") if key in value}
    return Method(**value, name=str(name))


def _scene(value: Any, where: str) -> Scene:
    value = _description(value, Scene, "path", where)
    path = scene_path(value)
    _require(
        not Path(path).is_absolute() and path != "." and ".." not in Path(path).parts,
        f"{where}: {path!r} is no folder below --scenes. Give --scenes the folder that it lies in.",
    )
    return Scene(**{**value, "path": path})


def _description(value: Any, kind: type, first: str, where: str) -> dict[str, Any]:
    """Keys of a run or a scene; a text is the value of the `first`."""
    value = _checked(value if isinstance(value, dict) else {first: value}, kind, where)
    _require(isinstance(value.get(first), str), f"{where} names no {first}.")
    return value


def _checked(value: dict[str, Any], kind: type, where: str) -> dict[str, Any]:
    """The keys of a benchmark, a run or a scene, with its options in words; refuses unknown keys, and numbers that are
    not whole or too small."""
    known = {key.name: key.default for key in fields(kind) if key.name not in NO_KEYS.get(kind, ())}
    unknown = sorted(map(str, set(value) - set(known)))
    _require(not unknown, f"{where}: unknown key {', '.join(unknown)}. Known are {', '.join(known)}.")
    for key in sorted(value.keys() & LEASTS.keys()):
        least = LEASTS[key]
        for number in as_list(value[key]) if key in LISTS else [value[key]]:
            is_whole = isinstance(number, int) and not isinstance(number, bool) and number >= least
            is_open = number is known[key] is None or (kind is Method and number == OWN)
            _require(is_whole or is_open, f"{where}: {key} is {number!r}; give a whole number of at least {least}.")
    return {**value, "options": words_of(value.get("options", ()), f"{where}: options")}


def _with_runs_of_knobs(content: dict[str, Any], where: str) -> dict[str, Any]:
    """The same plan with runs: the default, and each value of each knob."""
    _require("runs" not in content, f"{where}: runs are made from {DEFAULT} and knobs. Leave runs out.")
    several = len(as_list(content.get("strategies", []))) > 1
    _require(not several, f"{where}: strategies names several. Make the others values of a knob.")
    _require(isinstance(content["knobs"], dict), f"{where}: knobs must map names to what is varied.")
    default = _description(content.get(DEFAULT, "nrfgs"), Method, "method", f"{where}: {DEFAULT}")
    runs = {DEFAULT: {**default, "knob": DEFAULT}}
    for knob, description in content["knobs"].items():
        for value, changes in _values(description, f"{where}: knobs: {knob}").items():
            name = f"{knob} {value}"
            _require(name not in runs, f"{where}: {name!r} is there twice. Give knobs distinct names.")
            changes = {"method": changes} if isinstance(changes, str) else changes
            _require(isinstance(changes, dict), f"{where}: {name} must be a method, or map keys of a run to values.")
            base = {"options": ()} if "method" in changes else default
            options = base["options"] + words_of(changes.get("options", ()), f"{where}: {name}: options")
            runs[name] = {**base, **changes, "options": options, "knob": str(knob)}
    return {**{key: value for key, value in content.items() if key not in (DEFAULT, "knobs")}, "runs": runs}


def _values(description: Any, where: str) -> dict[str, Any]:
    """Value of a knob -> changed keys of a run."""
    match description:
        case {"option": option, "values": list(values), **rest} if not rest:
            return {str(value): {"options": [option, str(value)]} for value in values}
        case {"steps": list(values), **rest} if not rest:
            return {str(value): {"steps": value} for value in values}
        case {"strategies": list(values), **rest} if not rest:
            return {str(value): {"strategies": [value]} for value in values}
        case {"settings": dict(settings), **rest} if not rest:
            return {str(name): changes for name, changes in settings.items()}
    raise InputError(
        f"{where} needs option and a list of values, or a list of steps or strategies, or settings: names of runs "
        "with their keys."
    )


def as_list(value: Any) -> list[Any]:
    """A list; of a single value, a list with that value."""
    return list(value) if isinstance(value, (list, tuple)) else [value]


def words_of(value: Any, where: str) -> tuple[str, ...]:
    """Words of options, from a string as in a shell, or a list."""
    _require(isinstance(value, (str, list, tuple)), f"{where} must be a string or a list of words.")
    try:
        return tuple(shlex.split(value)) if isinstance(value, str) else tuple(str(word) for word in value)
    except ValueError as error:
        raise InputError(f"{where} cannot be split into words ({error}).") from error


def _require_free(options: tuple[str, ...], given: dict[str, str], where: str) -> None:
    """Refuse options that the benchmark sets: ns-train takes the later of two."""
    for word in options:
        name = word.partition("=")[0].replace("_", "-")
        if name.startswith("--"):
            _require(name not in given, f"{where}: {name} is given by the benchmark; {given.get(name)}.")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise InputError(message)
