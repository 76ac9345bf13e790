# SPDX-License-Identifier: Apache-2.0
"""Plan of a benchmark: runs x strategies x scenes x seeds from a YAML file, and the command of each training.

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

import json
import re
import shlex
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from nrfgs_ns.errors import InputError

QUIET = (
    "--vis tensorboard --steps-per-eval-image 1000000 --steps-per-eval-all-images 1000000 "
    "--logging.local-writer.enable False --logging.profiler none"
).split()
"""Options without evaluation, viewer and terminal table during a training."""
OWN = "own"
"""Strategy or number of steps that the method chooses: no option."""
DEFAULT = "default"
"""The run that a plan with knobs compares all others with."""
AVERAGE = "average"
"""In the column of scenes: the average over scenes."""
PRESET_STEPS = {"nrfgs-fast": 10_000}
"""Presets that differ from their method by the number of steps -> training steps."""
SET_HERE = {
    **dict.fromkeys(("--output-dir", "--experiment-name", "--load-dir"), "leave it out"),
    **dict.fromkeys(("--max-num-iterations", "--time-budget"), "use steps, of the file or of a run"),
    "--steps-per-save": "use checkpoint_every",
    "--machine.seed": "use seeds",
}
"""Options of ns-train that the benchmark sets -> what to use instead."""


@dataclass(frozen=True)
class Method:
    """A run: a row of the table."""

    name: str
    method: str
    """method of ns-train"""
    options: tuple[str, ...] = ()
    """its options"""
    strategies: tuple[str, ...] = ()
    """instead of the benchmark's; another project's methods have only `own` by default"""
    steps: int | str | None = None
    """instead of the preset's, the scene's or the benchmark's; own: what the method chooses"""
    scenes: tuple[str, ...] = ()
    """only these scenes"""
    knob: str = ""
    """the knob that is varied"""


@dataclass(frozen=True)
class Scene:
    """A data set, and how it is read."""

    path: str
    """folder below --scenes"""
    downscale: int | None = None
    """read images_N; None: by size in nerfstudio's layout, full size in COLMAP's"""
    options: tuple[str, ...] = ()
    """options of the data parser"""
    steps: int | None = None
    """training steps, instead of the benchmark's"""
    views: int | None = None
    """number of training views to keep, evenly spaced"""
    held_out: int | None = None
    """first held-out view"""
    held_out_every: int = 8
    """from one held-out view to the next"""
    held_out_by: str = "name"
    """order of the views; place: blocks along the cameras' longest axis are held out, which leaves gaps"""

    @property
    def name(self) -> str:
        """Name in tables and records."""
        if self.held_out is None:
            return self.path if self.views is None else f"{self.views} views/{self.path}"
        fold = self.held_out if self.held_out_every == 8 else f"{self.held_out} of {self.held_out_every}"
        fold = f"place {fold}" if self.held_out_by == "place" else fold
        return "/".join(str(part) for part in (fold, self.views, self.path) if part is not None)


@dataclass
class Spec:
    """A benchmark."""

    runs: list[Method]
    """methods with options"""
    scenes: list[Scene]
    """data sets"""
    strategies: list[str] = field(default_factory=lambda: [OWN])
    """values of --pipeline.model.densification; NAME@N: NAME,budget=N; own: no option"""
    seeds: list[int] = field(default_factory=lambda: [42])
    """--machine.seed of each repetition"""
    steps: int = 30_000
    """training steps, except of scenes, presets and runs that have their own"""
    options: tuple[str, ...] = ()
    """options of ns-train for every run"""
    held_out: list[int] = field(default_factory=list)
    """first held-out view; each number makes one held-out version of each scene"""
    held_out_every: int = 8
    """from one held-out view to the next"""
    held_out_by: str = "name"
    """order of the views (see `Scene`)"""
    quick: bool = False
    """quality alone: no ns-eval, pictures or frame rates; checkpoints are removed"""
    train_views: int = 16
    """training images to evaluate, evenly spaced"""
    checkpoint_every: int = 5_000
    """steps between checkpoints"""
    jobs: int = 1
    """runs at once on each GPU, or on the CPU"""
    gpus: int = 1
    """GPUs to spread the runs over"""


@dataclass(frozen=True)
class Cell:
    """One training of a benchmark."""

    run: Method
    strategy: str
    scene: Scene
    seed: int

    @property
    def name(self) -> str:
        """Name of its files."""
        text = f"{self.run.name}-{self.strategy}-{self.scene.name}-{self.seed}"
        return re.sub(r"[^A-Za-z0-9_.@-]", "_", text)


@dataclass
class Job:
    """A training, and where its results go. The last three are those of `Spec`."""

    args: list[str]
    """command line of ns-train"""
    cell: dict[str, Any]
    """its run, strategy, scene and seed"""
    identity: dict[str, Any]
    """what decides the result, without paths"""
    steps: int | None
    """training steps in all; None: the method chooses them"""
    record: str
    """file to write"""
    work: str
    """folder for everything else"""
    train_views: int
    jobs: int
    quick: bool = False


class _Loader(yaml.SafeLoader):
    """YAML with unique keys: the later of two would silently replace the other."""

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(problem=f"{twice!r} twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def load_spec(path: Path, plan: str = "") -> dict[str, Any]:
    """Content of a YAML file, or of one of its `plans`, for `make_spec`; InputError if it cannot be read."""
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
    _known(content, Spec, where)
    for key in ("runs", "scenes"):
        _require(bool(content.get(key)), f"{where}: {key} is missing or empty. Name at least one.")
    _require(isinstance(content["runs"], dict), f"{where}: runs must map names to methods.")
    lists = {"strategies": [OWN], "seeds": [42], "held_out": []}
    spec = Spec(
        **{
            **content,
            **{key: as_list(content.get(key, default)) for key, default in lists.items()},
            "runs": [_method(name, value, f"{where}: runs: {name}") for name, value in content["runs"].items()],
            "scenes": [_scene(value, f"{where}: scenes") for value in as_list(content["scenes"])],
            "options": words_of(content.get("options", ()), f"{where}: options"),
        }
    )
    leasts = {"steps": 1, "jobs": 1, "gpus": 1, "train_views": 0, "checkpoint_every": 1, "held_out_every": 2}
    for key, least in leasts.items():
        _whole(getattr(spec, key), least, f"{where}: {key}")
    for key in ("seeds", "held_out"):
        for value in getattr(spec, key):
            _whole(value, 0, f"{where}: {key}")
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
    for strategy in strategies_of(run, spec):
        options = strategy_options(strategy)
        given = dict.fromkeys(options, f"strategy {strategy} gives it; use strategy own")
        _require_free((*spec.options, *run.options), given, where)
        _require(
            run.method.startswith("nrfgs") or not options,
            f"{where}: {run.method} knows no strategy {strategy!r}; only this project's methods do. Use own, and the "
            "method's options.",
        )


def cells_of(spec: Spec) -> list[Cell]:
    """All trainings: the first seed of everything before the second, strategy by strategy on each scene."""
    order = dict.fromkeys([*spec.strategies, *(name for run in spec.runs for name in strategies_of(run, spec))])
    return [
        Cell(run, strategy, scene, seed)
        for seed in spec.seeds
        for scene in spec.scenes
        for strategy in order
        for run in spec.runs
        if strategy in strategies_of(run, spec) and (not run.scenes or {scene.name, scene.path} & set(run.scenes))
    ]


def strategies_of(run: Method, spec: Spec) -> tuple[str, ...]:
    """Strategies of a run; another project's methods have their own."""
    return run.strategies or (tuple(spec.strategies) if run.method.startswith("nrfgs") else (OWN,))


def steps_of(spec: Spec, run: Method, scene: Scene) -> int | None:
    """Training steps: the run's, else the preset's, the scene's or the benchmark's; None: the method chooses them."""
    steps = run.steps or PRESET_STEPS.get(run.method) or scene.steps or spec.steps
    return None if steps == OWN else steps


def strategy_options(strategy: str) -> list[str]:
    """Options of ns-train for a strategy; NAME@N is NAME,budget=N. InputError if strategy or option is unknown."""
    if strategy == OWN:
        return []
    from nrfgs_ns.densification import strategy_from  # imports torch

    return ["--pipeline.model.densification", str(strategy_from(strategy.replace("@", ",budget=")))]


def command(spec: Spec, cell: Cell, parser: list[str], work: Path) -> list[str]:
    """Command line of ns-train for one training, with a data parser's options (`data.py`), saved below `work`."""
    steps = steps_of(spec, cell.run, cell.scene)
    # Only this project's methods resume from a checkpoint.
    every = spec.checkpoint_every if cell.run.method.startswith("nrfgs") and steps else 10**9
    return [
        cell.run.method,
        *("--output-dir", str(work), "--experiment-name", Path(cell.scene.path).name),
        *([] if steps is None else ["--max-num-iterations", str(steps)]),
        *("--steps-per-save", str(min(every, steps or every))),
        *("--machine.seed", str(cell.seed)),
        *QUIET,
        *spec.options,
        *strategy_options(cell.strategy),
        *cell.run.options,
        *parser,
    ]


def identity(spec: Spec, cell: Cell, parser: list[str] | None) -> dict[str, Any]:
    """What decides a run's result, without paths, which differ between machines.

    Args:
        parser: as for `command`; None: how the data are read is not compared.
    """
    drop = ("--output-dir", "--steps-per-save")
    args = command(spec, cell, [], Path())
    kept = [word for before, word in zip(["", *args], args, strict=False) if word not in drop and before not in drop]
    result = {"options": kept, "scene": cell.scene.name, "train_views": spec.train_views}
    if parser is not None:
        at = parser.index("--data")
        result["parser"] = [*parser[:at], *parser[at + 2 :]]
    return result


def differences(made_with: dict[str, Any], wanted: dict[str, Any]) -> str:
    """Words of a record's identity that the wanted one lacks; "" if they are equal."""
    words = []
    for key, value in wanted.items():
        if (had := made_with.get(key)) != value:
            both = isinstance(had, list) and isinstance(value, list)
            odd = [pair for pair in settings(had) if pair not in settings(value)] if both else [str(had)]
            words.append(f"{key}: {' '.join(odd) or 'fewer words'}")
    return "; ".join(words)


def settings(words: list[str]) -> list[str]:
    """Options of a command line, each with its value."""
    pairs = zip(["", *words], words, strict=False)
    return [f"{before} {word}" if before.startswith("--") and word[:2] != "--" else word for before, word in pairs]


def read_record(path: Path) -> dict[str, Any]:
    """Record of a finished run; InputError if the file is not a record."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if {"identity", "machine", "jobs", "train", "measured"} <= set(record):
            return record
    except (ValueError, TypeError):
        pass
    raise InputError(f"{path} is no record of a run. Remove it to run it again.")


def scene_path(value: Any) -> str:
    """Folder of a scene in a file."""
    return Path(str(value.get("path", value) if isinstance(value, dict) else value)).as_posix()


def _method(name: Any, value: Any, where: str) -> Method:
    value = _description(value, Method, "method", where)
    if value.get("steps") not in (None, OWN):
        _whole(value["steps"], 1, f"{where}: steps")
    for key in {"strategies", "scenes"} & set(value):
        value[key] = tuple(str(word) for word in as_list(value[key]))
    return Method(**{**value, "name": str(name)})


def _scene(value: Any, where: str) -> Scene:
    value = _description(value, Scene, "path", where)
    for key in ("downscale", "steps", "views"):
        if value.get(key) is not None:
            _whole(value[key], 1, f"{where}: {key}")
    path = scene_path(value)
    _require(
        not Path(path).is_absolute() and path != "." and ".." not in Path(path).parts,
        f"{where}: {path!r} is no folder below --scenes. Give --scenes the folder that it lies in.",
    )
    return Scene(**{**value, "path": path})


def _description(value: Any, kind: type, first: str, where: str) -> dict[str, Any]:
    """Keys of a run or a scene; a text is the value of the `first`."""
    value = dict(value) if isinstance(value, dict) else {first: value}
    _known(value, kind, where)
    _require(isinstance(value.get(first), str), f"{where} names no {first}.")
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


def _known(value: dict[str, Any], kind: type, where: str) -> None:
    set_here = {Method: ["name"], Scene: ["held_out", "held_out_every", "held_out_by"]}.get(kind, ())
    known = [key.name for key in fields(kind) if key.name not in set_here]
    unknown = sorted(map(str, set(value) - set(known)))
    _require(not unknown, f"{where}: unknown key {', '.join(unknown)}. Known are {', '.join(known)}.")


def _whole(value: Any, least: int, where: str) -> None:
    good = isinstance(value, int) and not isinstance(value, bool) and value >= least
    _require(good, f"{where} is {value!r}; give a whole number of at least {least}.")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise InputError(message)
