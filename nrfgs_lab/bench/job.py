# SPDX-License-Identifier: Apache-2.0
"""The command of a benchmark's training, what decides its result, and its record."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nrfgs_lab.bench.spec import QUIET, Cell, Spec, is_ours, steps_of, strategy_options
from nrfgs_ns.errors import InputError


@dataclass
class Job:
    """A training, and where its results go. The last three are those of `Spec`."""

    args: list[str]  # command line of ns-train
    cell: dict[str, Any]  # its run, strategy, scene and seed
    identity: dict[str, Any]  # what decides the result, without paths
    steps: int | None  # training steps in all; None: the method chooses them
    record: str  # file to write
    work: str  # folder for everything else
    train_views: int
    jobs: int
    quick: bool = False


def command(spec: Spec, cell: Cell, parser: list[str], work: Path) -> list[str]:
    """Command line of ns-train for one training, with a data parser's options (`data.py`), saved below `work`."""
    steps = steps_of(spec, cell.run, cell.scene)
    # Only this project's methods resume from a checkpoint.
    every = spec.checkpoint_every if is_ours(cell.run.method) and steps else 10**9
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
    """What decides a run's result, without paths; without a `parser` how the data are read is not compared."""
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
