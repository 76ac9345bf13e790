# SPDX-License-Identifier: Apache-2.0
"""What a command asks for of a benchmark's file, and what else of the file its report shows.

A file may be worked off in parts, by several commands, some of them at once: `--runs`, `--data`, `--strategies` and
`--seeds` choose. All of them report in the same folder, so a report has what its command asked for and whatever else of
the file has left records there.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import entry_points
from typing import Any

from nrfgs_lab.bench.spec import OWN, Spec, as_list, cells_of, scene_name
from nrfgs_ns.errors import InputError


def chosen_runs(words: tuple[str, ...], runs: dict[str, Any], where: str) -> dict[str, Any]:
    """The runs that a command line names.

    Args:
        words: each the name of a run in the file, METHOD, "METHOD OPTIONS", or "NAME=METHOD OPTIONS". A name in the
            file comes before a method of the same name.
        runs: those of the file.
        where: what error messages call the file.

    Returns:
        name -> run, as a file has them.

    Raises:
        InputError: a word is neither a run of the file nor begins with a method of ns-train.
    """
    chosen = {}
    for word in words:
        if word in runs:
            chosen[word] = runs[word]
            continue
        name, run = named_run(word)
        if not is_method(run["method"]):
            listed = f"The runs of {where} are {', '.join(runs)}. " if runs else ""
            raise InputError(
                f"--runs {word!r}: {run['method']!r} is no method of ns-train"
                f"{f', and {where} has no run of that name' if runs else ''}. {listed}"
                'Give the name of a run, METHOD, or "NAME=METHOD OPTIONS".'
            )
        chosen[name] = run
    return chosen


def named_run(text: str) -> tuple[str, dict[str, str]]:
    """A run as the command line gives it: METHOD OPTIONS or NAME=METHOD OPTIONS; options may have "=" too."""
    name, equals, rest = text.partition("=")
    if not equals or " -" in name:
        name, rest = text, text
    method, _, options = rest.strip().partition(" ")
    return name.strip(), {"method": method, "options": options}


def is_method(name: str) -> bool:
    """Whether ns-train has a method of this name."""
    if name in {plugin.name for plugin in entry_points(group="nerfstudio.method_configs")}:
        return True
    from nerfstudio.configs.method_configs import all_methods  # takes seconds, and is only needed for others' methods

    return name in all_methods


def chosen_scenes(names: tuple[str, ...], scenes: Any) -> list[Any]:
    """The data sets that a command line names: as the file reads them, if it has them."""
    by_name = {scene_name(scene): scene for scene in as_list(scenes)}
    return [by_name.get(scene_name(name), name) for name in names]


def united(file: dict[str, Any], asked: dict[str, Any]) -> dict[str, Any]:
    """What is asked for, among all runs, scenes, strategies and seeds of the file.

    Args:
        file: content of a file; empty if there is none.
        asked: the content with a command's options over it. Everything but those four is taken from here.
    """
    if not file:
        return asked
    runs = {str(name): run for name, run in {**(file.get("runs") or {}), **asked["runs"]}.items()}
    scenes = {scene_name(scene): scene for key in (file, asked) for scene in as_list(key.get("scenes") or [])}
    together = {**asked, "runs": runs, "scenes": list(scenes.values())}
    for key, default in (("strategies", [OWN]), ("seeds", [42])):
        if key in asked:
            of_file = as_list(file.get(key, default))
            together[key] = of_file + [one for one in as_list(asked[key]) if one not in of_file]
    return together


def with_records(whole: Spec, asked: Spec, is_there: Callable[[str], bool]) -> Spec:
    """The benchmark that a report shows.

    Args:
        whole: everything.
        asked: the part that a command asked for.
        is_there: whether a training, by the name of its files, has left something to report.
    """
    there = [cell for cell in cells_of(whole) if is_there(cell.name)]
    return replace(
        whole,
        runs=[run for run in whole.runs if run in asked.runs or any(cell.run == run for cell in there)],
        scenes=[one for one in whole.scenes if one in asked.scenes or any(cell.scene == one for cell in there)],
        strategies=[
            one for one in whole.strategies if one in asked.strategies or any(c.strategy == one for c in there)
        ],
        seeds=[seed for seed in whole.seeds if seed in asked.seeds or any(cell.seed == seed for cell in there)],
    )
