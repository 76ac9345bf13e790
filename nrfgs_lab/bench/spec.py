# SPDX-License-Identifier: Apache-2.0
"""What a benchmark consists of: runs x strategies x scenes x seeds, from a YAML file, and the command of each.

    runs:                                   # name -> method of ns-train, or method and options
      SH: nrfgs-sh
      NRF-16: {method: nrfgs, options: --pipeline.model.appearance.latent-dim 16}
      splatfacto: {method: splatfacto, strategies: [own]}
    strategies: [original, mcmc@200000]      # densification, and the budget of mcmc; `own`: the method's, no option
    scenes: [bonsai, {path: garden, downscale: 4}]
    seeds: [42, 43]
    steps: 30000

All keys of a file are fields of `Spec`.
"""

import json
import re
import shlex
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml

from nrfgs_ns.errors import InputError

QUIET = (
    "--vis tensorboard --steps-per-eval-image 1000000 --steps-per-eval-all-images 1000000 "
    "--logging.local-writer.enable False --logging.profiler none"
).split()
"""Options that keep evaluation, the viewer and the terminal table out of the timing."""
OWN = "own"
"""The strategy of a method that is run as it is."""
DENSIFICATION = "--pipeline.model.densification"
"""The option by which a strategy is told."""
AVERAGE = "average"
"""What stands for the scene in the rows of averages over scenes."""
PRESET_STEPS = {"nrfgs-fast": 10_000}
"""Method -> training steps, of methods that are what they are by the number of their steps."""
SET_HERE = {
    **dict.fromkeys(("--output-dir", "--experiment-name", "--load-dir"), "leave it out"),
    **dict.fromkeys(("--max-num-iterations", "--time-budget"), "use steps, of the file or of a run"),
    "--steps-per-save": "use checkpoint_every",
    "--machine.seed": "use seeds",
}
"""Options of ns-train that a run cannot have, because the benchmark gives them; what to use instead."""


@dataclass(frozen=True)
class Method:
    """A row of the table: a method of ns-train, and options."""

    name: str
    method: str
    options: tuple[str, ...] = ()
    strategies: tuple[str, ...] | None = None
    """instead of the benchmark's; a method that is not of this project has `own` only, unless it says otherwise"""
    steps: int | None = None
    """instead of the benchmark's, or of the preset's"""


@dataclass(frozen=True)
class Scene:
    """A data set: a folder below the root, and how it is read."""

    name: str
    downscale: int | None = None
    """use the images of images_N; None: nerfstudio's layout decides by size, COLMAP's takes the full size"""
    options: tuple[str, ...] = ()
    """options of the data parser"""

    @property
    def short_name(self) -> str:
        """Last part of the path, which tables show."""
        return Path(self.name).name


@dataclass
class Spec:
    """A benchmark."""

    runs: list[Method]
    """methods with options, each under a name"""
    scenes: list[Scene]
    """data sets"""
    strategies: list[str] = field(default_factory=lambda: [OWN])
    """densification: splatfacto, original, mcmc, mcmc@BUDGET, or own for no option at all"""
    seeds: list[int] = field(default_factory=lambda: [42])
    """--machine.seed of each repetition"""
    steps: int = 30_000
    """training steps, except of runs and presets that have their own"""
    options: tuple[str, ...] = ()
    """options of ns-train for every run"""
    train_views: int = 16
    """training images, evenly spaced, that are evaluated beside the test images"""
    checkpoint_every: int = 5_000
    """steps between checkpoints, from which an interrupted run goes on"""
    jobs: int = 1
    """runs at once on each GPU, or on the CPU"""
    gpus: int = 1
    """GPUs to spread the runs over"""
    crops: dict[str, list[int]] = field(default_factory=dict)
    """scene -> numbers of the test views to compare in pictures, from 0; where methods differ most if left out"""


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
    """What the benchmark asks of a run."""

    args: list[str]
    """command line of ns-train"""
    identity: dict[str, Any]
    """what decides the result, without paths: a record is compared with it"""
    steps: int
    """training steps in all"""
    record: str
    """file to write"""
    work: str
    """folder for everything else; pictures of the test views lie in its `pictures`"""
    train_views: int
    """training images to evaluate"""
    jobs: int
    """runs that share the GPU: times mean something only if it is 1"""


class _Loader(yaml.SafeLoader):
    """YAML in which no key stands twice: the later one would silently replace the other."""

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(problem=f"{twice!r} twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def load_spec(path: Path) -> dict[str, Any]:
    """The content of a YAML file: a mapping, as `make_spec` takes it.

    Raises:
        InputError: the file cannot be read, or is no mapping.
    """
    try:
        content = yaml.load(Path(path).read_text(encoding="utf-8"), Loader=_Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path} cannot be read as YAML ({error}). See docs/bench.md for an example.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} must be a mapping (runs: ..., scenes: ...). See docs/bench.md for an example.")
    return content


def make_spec(content: dict[str, Any], where: str) -> Spec:
    """Check and complete the content of a file.

    Args:
        content: keys and values as in the module's docstring.
        where: what error messages call it.

    Raises:
        InputError: naming the key and the fix.
    """
    known = [one.name for one in fields(Spec)]
    for key in content:
        _require(key in known, f"{where}: unknown key {key!r}. Known are {', '.join(known)}.")
    for key in ("runs", "scenes"):
        _require(bool(content.get(key)), f"{where}: {key} is missing or empty. Name at least one.")
    _require(isinstance(content["runs"], dict), f"{where}: runs must map names to methods.")
    spec = Spec(
        **{
            **content,
            "runs": [_method(name, value, where) for name, value in content["runs"].items()],
            "scenes": [_scene(value, where) for value in as_list(content["scenes"])],
            "strategies": [str(value) for value in as_list(content.get("strategies", [OWN]))],
            "seeds": as_list(content.get("seeds", [42])),
            "options": words_of(content.get("options", ()), f"{where}: options"),
        }
    )
    for key, least in (("steps", 1), ("jobs", 1), ("gpus", 1), ("train_views", 0), ("checkpoint_every", 1)):
        _whole(getattr(spec, key), least, f"{where}: {key}")
    for key in ("strategies", "seeds"):
        _require(bool(getattr(spec, key)), f"{where}: {key} is empty. Name at least one, or leave it out.")
    views = isinstance(spec.crops, dict) and all(
        isinstance(chosen, list) and all(isinstance(view, int) for view in chosen) for chosen in spec.crops.values()
    )
    _require(views, f"{where}: crops must map scenes to lists of numbers of test views, such as {{bonsai: [0, 5]}}.")
    for seed in spec.seeds:
        _whole(seed, 0, f"{where}: seeds")
    _require_free(spec.options, f"{where}: options")
    for run in spec.runs:
        _require_free(run.options, f"{where}: runs: {run.name}: options")
        for strategy in run.strategies or spec.strategies:
            options = strategy_options(strategy)
            own = {option_name(word) for word in (*spec.options, *run.options) if word.startswith("--")}
            twice = ", ".join(sorted(own.intersection(options)))
            _require(
                not twice,
                f"{where}: runs: {run.name}: {twice} is what strategy {strategy} gives; leave it out, or use strategy "
                "own.",
            )
            _require(
                not (run.strategies and options) or run.method.startswith("nrfgs"),
                f"{where}: runs: {run.name}: {run.method} knows no strategy {strategy!r}; only this project's methods "
                "do. Use own, and the method's options.",
            )
    cells = cells_of(spec)
    names = [cell.name for cell in cells]
    twice = sorted({name for name in names if names.count(name) > 1})
    _require(
        not twice,
        f"{where}: {', '.join(twice[:3])} would be trained twice. Give runs and scenes distinct names, and each "
        "strategy and seed once.",
    )
    return spec


def cells_of(spec: Spec) -> list[Cell]:
    """All trainings, the first seed of everything before the second."""
    return [
        Cell(run, strategy, scene, seed)
        for seed in spec.seeds
        for scene in spec.scenes
        for strategy, run in rows_of(spec)
    ]


def rows_of(spec: Spec) -> list[tuple[str, Method]]:
    """Pairs (strategy, run): the rows of the table for each scene, strategy by strategy."""

    def strategies(run: Method) -> list[str]:
        return list(run.strategies or (spec.strategies if run.method.startswith("nrfgs") else [OWN]))

    order = list(dict.fromkeys([*spec.strategies, *(name for run in spec.runs for name in strategies(run))]))
    return [(strategy, run) for strategy in order for run in spec.runs if strategy in strategies(run)]


def steps_of(spec: Spec, run: Method) -> int:
    """Training steps of a run: its own, those of its preset, or the benchmark's."""
    return PRESET_STEPS.get(run.method, spec.steps) if run.steps is None else run.steps


def strategy_options(strategy: str) -> list[str]:
    """Options of ns-train for a strategy of densification.

    Raises:
        InputError: there is no such strategy.
    """
    name, at, budget = strategy.partition("@")
    if strategy == OWN:
        return []
    known = ("splatfacto", "original", "mcmc")
    good = name in known and (not at or (name == "mcmc" and budget.isdecimal() and int(budget) > 0))
    _require(good, f"strategy {strategy!r} is unknown; use {', '.join(known)}, mcmc@BUDGET or own.")
    return [DENSIFICATION, name, *(["--pipeline.model.splat-budget", budget] if at else [])]


def command(spec: Spec, cell: Cell, parser: list[str], work: Path) -> list[str]:
    """The command line of ns-train for one training.

    Args:
        parser: the data parser and its options (see `bench_data`).
        work: folder for checkpoints.
    """
    # Only this project's methods go on from a checkpoint.
    steps = steps_of(spec, cell.run)
    every = spec.checkpoint_every if cell.run.method.startswith("nrfgs") else steps
    return [
        cell.run.method,
        *("--output-dir", str(work), "--experiment-name", cell.scene.short_name),
        *("--max-num-iterations", str(steps), "--steps-per-save", str(min(every, steps))),
        *("--machine.seed", str(cell.seed)),
        *QUIET,
        *spec.options,
        *strategy_options(cell.strategy),
        *cell.run.options,
        *parser,
    ]


def identity(spec: Spec, cell: Cell, parser: list[str] | None) -> dict[str, Any]:
    """A record's fingerprint: what decides the result, without paths, which differ between machines.

    Args:
        parser: as for `command`; None if the data are not there, and how they are read is not to be compared.
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
    """In which words a record's fingerprint differs from the wanted one; empty if it does not."""
    words = []
    for key, value in wanted.items():
        had = made_with.get(key)
        if had == value:
            continue
        both = isinstance(had, list) and isinstance(value, list)
        odd = [one for one in settings(had) if one not in settings(value)] if both else [str(had)]
        words.append(f"{key}: {' '.join(odd) or 'fewer words'}")
    return "; ".join(words)


def settings(words: list[str]) -> list[str]:
    """Words of a command line, each value with its option before it."""
    pairs = zip(["", *words], words, strict=False)
    return [f"{before} {word}" if before.startswith("--") and word[:2] != "--" else word for before, word in pairs]


def read_record(path: Path) -> dict[str, Any]:
    """What a finished run left.

    Raises:
        InputError: the file is not a record.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is not a record of a run ({error}). Remove it to have the run made anew.") from error
    kinds = {"identity": dict, "machine": dict, "jobs": int, "train": dict, "measured": dict}
    found = record if isinstance(record, dict) else {}
    lacks = ", ".join(key for key, kind in kinds.items() if not isinstance(found.get(key), kind))
    _require(not lacks, f"{path} is no whole record: it lacks {lacks}. Remove it to have the run made anew.")
    return record


def scene_name(value: Any) -> str:
    """The folder of a scene as a file gives it."""
    return Path(str(value.get("path", value) if isinstance(value, dict) else value)).as_posix()


def _method(name: str, value: Any, where: str) -> Method:
    value = {"method": value} if isinstance(value, str) else value
    where = f"{where}: runs: {name}"
    _require(isinstance(value, dict) and isinstance(value.get("method"), str), f"{where} names no method.")
    one = len(value["method"].split()) == 1
    _require(one, f"{where}: {value['method']!r} is no single word; use {{method: METHOD, options: OPTIONS}}.")
    unknown = sorted(set(value) - {"method", "options", "strategies", "steps"})
    _require(not unknown, f"{where}: unknown key {unknown}. Known are method, options, strategies, steps.")
    if value.get("steps") is not None:
        _whole(value["steps"], 1, f"{where}: steps")
    strategies = tuple(str(one) for one in as_list(value["strategies"])) if "strategies" in value else None
    _require(strategies != (), f"{where}: strategies is empty. Name at least one, or leave it out.")
    options = words_of(value.get("options", ()), f"{where}: options")
    return Method(str(name), value["method"], options, strategies, value.get("steps"))


def _scene(value: Any, where: str) -> Scene:
    value = {"path": value} if isinstance(value, (str, Path)) else value
    _require(isinstance(value, dict) and "path" in value, f"{where}: scenes: {value!r} is neither a path nor has one.")
    unknown = sorted(set(value) - {"path", "downscale", "options"})
    _require(not unknown, f"{where}: scenes: unknown key {unknown}. Known are path, downscale, options.")
    downscale = value.get("downscale")
    if downscale is not None:
        _whole(downscale, 1, f"{where}: scenes: downscale")
    name = scene_name(value)
    _require(
        not Path(name).is_absolute() and name != "." and ".." not in Path(name).parts,
        f"{where}: scenes: {name!r} is no folder below --scenes. Give --scenes the folder that it lies in.",
    )
    _require(name != AVERAGE, f"{where}: scenes: {name!r} is what the table calls the average over scenes; rename it.")
    return Scene(name, downscale, words_of(value.get("options", ()), f"{where}: scenes: options"))


def as_list(value: Any) -> list[Any]:
    """A single value is a list of one."""
    return list(value) if isinstance(value, (list, tuple)) else [value]


def words_of(value: Any, where: str) -> tuple[str, ...]:
    """Options given as one string, as in a shell, or as a list of words."""
    _require(isinstance(value, (str, list, tuple)), f"{where} must be a string or a list of words.")
    try:
        return tuple(shlex.split(value)) if isinstance(value, str) else tuple(str(word) for word in value)
    except ValueError as error:
        raise InputError(f"{where} cannot be told apart into words ({error}).") from error


def option_name(word: str) -> str:
    """The option in a word of a command line, as `ns-train --help` writes it."""
    return word.partition("=")[0].replace("_", "-")


def _require_free(options: tuple[str, ...], where: str) -> None:
    """Refuse options that the benchmark gives itself: ns-train would take the later one."""
    for word in options:
        name = option_name(word)
        _require(name not in SET_HERE, f"{where}: {name} is given by the benchmark; {SET_HERE.get(name)}.")


def _whole(value: Any, least: int, where: str) -> None:
    good = isinstance(value, int) and not isinstance(value, bool) and value >= least
    _require(good, f"{where} is {value!r}; give a whole number of at least {least}.")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise InputError(message)
