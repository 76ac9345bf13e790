# SPDX-License-Identifier: Apache-2.0
"""`nrfgs bench`: methods x strategies x scenes x seeds, one table, one figure, one sheet of crops for each scene.

Each training is a process of its own (`run.py`) that writes OUT/runs/NAME.json at its end. The next call skips finished
runs, resumes interrupted ones and retries failed ones. A record with other arguments stops the benchmark.

Several commands may share a file and a folder, also at once: a report has the trainings that its command chose, and all
others of the file with a record there.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from nrfgs_lab.bench.data import parser_options
from nrfgs_lab.bench.report import FAILURE, report
from nrfgs_lab.bench.spec import (
    DEFAULT,
    OWN,
    Cell,
    Job,
    Scene,
    Spec,
    as_list,
    cells_of,
    command,
    differences,
    identity,
    load_spec,
    make_spec,
    read_record,
    scene_path,
    steps_of,
)
from nrfgs_lab.lock import only_one
from nrfgs_ns.errors import InputError
from nrfgs_ns.files import check_writable, write_whole

CHILD = (sys.executable, "-m", "nrfgs_lab.bench.run")
"""Command of a child; the file that describes its job is appended."""
POLL_SECONDS = 0.2


@dataclass
class Running:
    """A running child."""

    name: str
    process: subprocess.Popen
    log: IO
    job: Job

    def steps(self) -> int:
        """Training steps, as the child noted them."""
        try:
            return int(json.loads((Path(self.job.work) / "progress.json").read_text(encoding="utf-8"))["step"])
        except (OSError, ValueError, KeyError):
            return 0


@dataclass
class Bench:
    """Compare methods over strategies, scenes and seeds: train all, and report. See docs/bench.md."""

    spec: Annotated[Path | None, tyro.conf.Positional] = None
    """YAML file with runs or knobs, strategies, scenes, seeds, ...; options given here override it"""
    plan: str = ""
    """the plan to run, of a file with several"""
    scenes: Path = Path(".")
    """folder in which the data sets lie"""
    out: Path = Path("bench")
    """folder for runs/*.json and the report"""
    work: Path = Path("outputs/bench")
    """folder for checkpoints, pictures and logs"""
    data: tuple[str, ...] = ()
    """data sets: folders in --scenes"""
    runs: tuple[str, ...] = ()
    """runs or knobs of the file by name, or methods, each METHOD or "NAME=METHOD OPTIONS" """
    strategies: tuple[str, ...] = ()
    """values of --pipeline.model.densification, NAME@BUDGET, own"""
    seeds: tuple[int, ...] = ()
    """seeds (--machine.seed), one training for each"""
    steps: int | None = None
    """training steps, except of scenes, runs and presets that have their own"""
    options: str | None = None
    """options of ns-train for every run"""
    train_views: int | None = None
    """number of training images to evaluate, too"""
    jobs: int | None = None
    """runs at once on each GPU, or on the CPU; times are reported only with 1"""
    gpus: int | None = None
    """GPUs to spread the runs over"""
    minutes: float | None = None
    """stop after this time; the next call goes on"""
    report_only: bool = False
    """run nothing: report what is there"""
    redo_stale: bool = False
    """rename records of other arguments to NAME.stale, and run them again"""

    def main(self) -> None:
        plan, chosen = self.chosen()
        check_writable(self.out / "table.md", "--out")
        parsers = None if self.report_only else self.parsers(chosen)
        stale = self.stale(plan, chosen, parsers)
        if stale and not self.report_only:
            if not self.redo_stale:
                name, difference = next(iter(stale.items()))
                raise InputError(
                    f"{len(stale)} of the records in {self.out / 'runs'} were made with other arguments; {name} had "
                    f"{difference}. Give --redo-stale to rename them and run them again, or another --out."
                )
            for name in stale:
                with contextlib.suppress(FileNotFoundError):  # another command has done it
                    os.replace(self.record(name), self.record(name).with_suffix(".stale"))
        jobs = self.jobs_of(plan, chosen, parsers) if parsers else {}
        pending = {name: job for name, job in jobs.items() if not self.record(name).exists()}
        if pending:
            for run in dict.fromkeys(cell.run for cell in chosen):
                if not is_method(run.method):
                    raise InputError(f"{self.spec}: runs: {run.name}: {run.method!r} is no method of ns-train.")
            # A terminated benchmark must not leave its children behind; an exception reaches the `finally` below.
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
            self.run_all(pending, plan)
        # Another command may end at this moment: whoever reports last must have read the records of both.
        with only_one(self.out / ".lock", "Another command reports here; waiting for it to end."):
            cells = self.shown(plan, chosen)
            report(plan, cells, self.out, self.work, self.stale(plan, cells, parsers))
        failed = [cell.name for cell in chosen if self.has_failed(cell.name)]
        if failed and not self.report_only:
            sys.exit(f"nrfgs: {len(failed)} of the runs FAILED: {', '.join(failed)}. Logs: {self.work}/NAME.log")

    def chosen(self) -> tuple[Spec, list[Cell]]:
        """The whole benchmark, and the trainings that this command chooses."""
        where = str(self.spec or "nrfgs bench")
        content = load_spec(self.spec, self.plan) if self.spec else {}
        given = {"steps": self.steps, "options": self.options, "train_views": self.train_views, "jobs": self.jobs}
        content |= {key: value for key, value in {**given, "gpus": self.gpus}.items() if value is not None}
        data, of_file = [scene_path(name) for name in self.data], as_list(content.get("scenes") or [])
        content["scenes"] = of_file + [name for name in data if name not in map(scene_path, of_file)]
        for key, default in (("strategies", OWN), ("seeds", 42)):
            if values := getattr(self, key):
                of_file = as_list(content.get(key, default)) if self.spec else []
                content[key] = of_file + [value for value in values if value not in of_file]
        runs = content.get("runs") or {}
        known = set(map(str, runs))
        if "knobs" in content:
            known = {name for run in make_spec(content, where).runs for name in (run.name, run.knob)}
        new = dict(named_run(word, known, where) for word in self.runs if word not in known)
        if new:
            content["runs"] = {**{str(name): run for name, run in runs.items()}, **new}
        plan = make_spec(content, where)
        names = {*self.runs, *new, *([DEFAULT] if "knobs" in content else [])}

        def is_chosen(cell: Cell) -> bool:
            follows = cell.run.strategies is None and cell.run.method.startswith("nrfgs")
            return (
                (not self.runs or cell.run.name in names or cell.run.knob in names)
                and (not data or cell.scene.path in data)
                and (not self.seeds or cell.seed in self.seeds)
                and (not self.strategies or not follows or cell.strategy in self.strategies)
            )

        return plan, [cell for cell in cells_of(plan) if is_chosen(cell)]

    def shown(self, plan: Spec, chosen: list[Cell]) -> list[Cell]:
        """The trainings of a report: the chosen ones, and all others of the file with a record or a failure."""
        every = cells_of(plan)
        rows = list(dict.fromkeys((cell.scene, cell.strategy, cell.run) for cell in every))
        others = [cell for cell in every if self.record(cell.name).exists() or self.has_failed(cell.name)]
        return sorted(
            {*chosen, *others}, key=lambda cell: (rows.index((cell.scene, cell.strategy, cell.run)), cell.seed)
        )

    def record(self, name: str) -> Path:
        """The record of a finished run."""
        return self.out / "runs" / f"{name}.json"

    def has_failed(self, name: str) -> bool:
        """Whether a run's last attempt failed."""
        return self.record(name).with_suffix(FAILURE).exists() and not self.record(name).exists()

    def parsers(self, cells: list[Cell]) -> dict[Scene, list[str]]:
        """Scene -> the data parser and its options. A data set that cannot be read fails now."""
        scenes = dict.fromkeys(cell.scene for cell in cells)
        return {scene: parser_options(self.scenes, scene, self.work / "scenes") for scene in scenes}

    def jobs_of(self, plan: Spec, cells: list[Cell], parsers: dict[Scene, list[str]]) -> dict[str, Job]:
        """Name -> job of every training."""
        return {
            cell.name: Job(
                args=command(plan, cell, parsers[cell.scene], self.work / cell.name),
                cell={"run": cell.run.name, "strategy": cell.strategy, "scene": cell.scene.name, "seed": cell.seed},
                identity=identity(plan, cell, parsers[cell.scene]),
                steps=steps_of(plan, cell.run, cell.scene),
                record=str(self.record(cell.name)),
                work=str(self.work / cell.name),
                train_views=plan.train_views,
                jobs=plan.jobs,
                quick=plan.quick,
            )
            for cell in cells
        }

    def stale(self, plan: Spec, cells: list[Cell], parsers: dict[Scene, list[str]] | None) -> dict[str, str]:
        """Records whose arguments are not those of the plan: name -> difference."""
        result = {}
        for cell in cells:
            if self.record(cell.name).exists():
                made_with = read_record(self.record(cell.name))["identity"]
                wanted = identity(plan, cell, parsers.get(cell.scene) if parsers else None)
                if difference := differences(made_with, wanted):
                    result[cell.name] = difference
        return result

    def run_all(self, pending: dict[str, Job], plan: Spec) -> None:
        """Run the jobs, `plan.jobs` at once on each GPU, with the time that is left."""
        for folder in (self.out / "runs", self.work):
            folder.mkdir(parents=True, exist_ok=True)
        waiting, running, finished, steps_finished = list(pending.items()), {}, 0, 0
        slots = [gpu for _ in range(plan.jobs) for gpu in gpu_names(plan.gpus)]
        # A training on a GPU needs few CPU threads, but torch takes all cores: side by side they wait for each other.
        threads = max(1, (os.cpu_count() or 1) // len(slots))
        end = float("inf") if self.minutes is None else time.monotonic() + 60 * self.minutes
        columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
        with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:

            def say(text: str) -> None:
                progress.console.print(text, highlight=False, markup=False, soft_wrap=True)

            bar = progress.add_task("", total=sum(job.steps or 1 for job in pending.values()))
            try:
                while waiting or running:
                    if time.monotonic() > end:
                        say(f"Time is up: {len(waiting) + len(running)} runs are left for the next call.")
                        break
                    for slot, gpu in enumerate(slots):
                        if slot in running and running[slot].process.poll() is not None:
                            done = running.pop(slot)
                            done.log.close()
                            finished, steps_finished = finished + 1, steps_finished + (done.job.steps or 1)
                            record = Path(done.job.record)
                            good = done.process.returncode == 0 and record.exists()
                            say(f"{done.name}: {'done' if good else 'FAILED'}")
                            if not good:
                                note = {"returncode": done.process.returncode, "identity": done.job.identity}
                                write_whole(record.with_suffix(FAILURE), json.dumps(note, indent=1) + "\n")
                                say(f"  see {done.log.name}")
                        if slot not in running and waiting:
                            running[slot] = self.start(*waiting.pop(0), gpu, threads)
                            say(f"{running[slot].name}: started")
                    steps = steps_finished + sum(child.steps() for child in running.values())
                    progress.update(bar, completed=steps, description=f"{finished} of {len(pending)} runs")
                    time.sleep(POLL_SECONDS)
            finally:
                for child in running.values():
                    child.process.terminate()
                for child in running.values():
                    child.process.wait()
                    child.log.close()

    def start(self, name: str, job: Job, gpu: str, threads: int) -> Running:
        """Start a job on a GPU. OMP_NUM_THREADS goes before `threads`."""
        self.record(name).with_suffix(FAILURE).unlink(missing_ok=True)
        file = self.work / f"{name}.job.json"
        write_whole(file, json.dumps(asdict(job), indent=1))
        log = (self.work / f"{name}.log").open("a")
        environment = {"OMP_NUM_THREADS": str(threads), **os.environ, "CUDA_VISIBLE_DEVICES": gpu}
        process = subprocess.Popen([*CHILD, str(file)], stdout=log, stderr=subprocess.STDOUT, env=environment)
        return Running(name, process, log, job)


def named_run(word: str, known: set[str], where: str) -> tuple[str, dict[str, str]]:
    """Name and run of METHOD OPTIONS or NAME=METHOD OPTIONS (options may have "=", too), or InputError."""
    name, equals, rest = word.partition("=")
    if not equals or " -" in name:
        name, rest = word, word
    method, _, options = rest.strip().partition(" ")
    if not is_method(method):
        listed = f", and {where} has no run of that name. It has {', '.join(sorted(known))}" if known else ""
        raise InputError(
            f"--runs {word!r}: {method!r} is no method of ns-train{listed}. "
            'Give the name of a run, METHOD, or "NAME=METHOD OPTIONS".'
        )
    return name.strip(), {"method": method, "options": options}


def is_method(name: str) -> bool:
    """Whether ns-train has a method of this name."""
    from importlib.metadata import entry_points

    if name in {plugin.name for plugin in entry_points(group="nerfstudio.method_configs")}:
        return True
    from nerfstudio.configs.method_configs import all_methods  # takes seconds, and is only needed for others' methods

    return name in all_methods


def gpu_names(count: int) -> list[str]:
    """Values of CUDA_VISIBLE_DEVICES for `count` of the visible GPUs, or InputError; "", which hides all, stays."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        names, limit = visible.split(","), f"CUDA_VISIBLE_DEVICES is {visible!r}"
    elif count > 1:
        import torch  # takes seconds, and one may be asked for where there is none: then the CPU trains

        names = [str(index) for index in range(torch.cuda.device_count())]
        limit = f"this machine has {len(names)}"
    else:
        return ["0"]
    if len(names) < count:
        raise InputError(f"gpus is {count}, but {limit}. Ask for at most {max(1, len(names))}.")
    return names[:count]
